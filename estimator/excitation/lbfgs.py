"""Smooth minimisation by limited-memory BFGS (Nocedal and Wright, Numerical Optimization, 2nd ed., algorithm 7.5).

It is implemented here because a seed must give the same phases on every machine. With a library's BLAS, the waves of
two machines could differ by up to 4e-4 of the peak (docs/dependencies.md).
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from hil.estimator.arrays import Array

Function = Callable[[Array], tuple[float, Array]]

MEMORY = 20  # steps remembered
HALVINGS = 20
ENOUGH = 1e-4  # minimum decrease as a fraction of that predicted by the slope
GRID = 2.0**-24  # steps are rounded to a multiple of this
Pairs = deque[tuple[Array, Array, float]]
_sum: Callable[[Array], Any] = np.add.reduce  # np.sum takes three times as long for so few numbers


def descend(function: Function, x: Array, steps: int) -> Array:
    """Minimise a function from `x` in at most `steps` steps; return the last `x`.

    `function` returns its value and its gradient.

    Steps are rounded to a grid. Otherwise the last bit of a cosine, which depends on the processor, might lead to
    another minimum.
    """
    value, gradient = function(x)
    pairs: Pairs = deque(maxlen=MEMORY)
    for _ in range(steps):
        direction = _direction(gradient, pairs)
        slope = float(_sum(gradient * direction))
        length = 1.0 if pairs else 1.0 / max(1.0, float(np.sqrt(_sum(gradient**2))))
        for _ in range(HALVINGS):
            reached = _on_grid(x + length * direction)
            there, gradient_there = function(reached)
            if there <= value + ENOUGH * length * slope:
                break
            length *= 0.5
        else:
            return x
        moved, turned = reached - x, gradient_there - gradient
        curvature = float(_sum(moved * turned))
        if curvature > 0.0:
            pairs.append((moved, turned, 1.0 / curvature))
        x, value, gradient = reached, there, gradient_there
    return x


def _on_grid(x: Array) -> Array:
    return np.asarray(np.rint(x / GRID) * GRID)


def _direction(gradient: Array, pairs: Pairs) -> Array:
    """Return minus the product of the gradient and the inverse Hessian approximated from the stored steps."""
    left, product = gradient.copy(), np.empty_like(gradient)
    shares = []
    for moved, turned, inverse in reversed(pairs):
        share = inverse * _sum(np.multiply(moved, left, product))
        left -= np.multiply(turned, share, product)
        shares.append(share)
    if pairs:
        _, turned, inverse = pairs[-1]
        left /= inverse * _sum(turned**2)
    for (moved, turned, inverse), share in zip(pairs, reversed(shares), strict=True):
        left += np.multiply(moved, share - inverse * _sum(np.multiply(turned, left, product)), product)
    return -left
