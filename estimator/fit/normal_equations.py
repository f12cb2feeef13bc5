"""Compiled products for least squares, without BLAS or a weighted copy of the Jacobian.

They are as fast as BLAS with one thread. With several threads, BLAS would be ten times slower for products of this size
on a busy machine, and the last digits of a fit would depend on the number of threads (docs/dependencies.md).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.compiled import compiled

LANES = 8


def normal_equations(jacobian: Array, residual: Array, weight: Array | None = None) -> tuple[Array, Array]:
    """Return J'WJ (columns, columns) and J'Wr (columns,).

    jacobian: J (rows, columns). residual: r (rows,). weight: diagonal of W (rows,), by default 1.
    """
    products = Products(jacobian.shape[1])
    products.add(jacobian, residual, np.ones(len(residual)) if weight is None else weight)
    return products.sums


class Products:
    """Normal equations accumulated from several sets of rows."""

    def __init__(self, columns: int) -> None:
        self._product = np.zeros((columns, columns + 1))

    def add(self, jacobian: Array, residual: Array, weight: Array) -> None:
        """Add rows; arguments as in `normal_equations`."""
        _multiply(np.ascontiguousarray(jacobian), residual, weight, self._product)

    @property
    def sums(self) -> tuple[Array, Array]:
        """J'WJ (columns, columns) and J'Wr (columns,)."""
        normal = np.tril(self._product[:, :-1])
        return normal + np.tril(normal, -1).T, self._product[:, -1]


def _loop(J: Any, r: Any, weight: Any, product: Any) -> None:
    rows, columns = J.shape
    # Four rows and two columns at a time: fewer memory accesses, and half as many short loops.
    for first in range(0, rows, 4):
        i, j, k, m = first, min(first + 1, rows - 1), min(first + 2, rows - 1), min(first + 3, rows - 1)
        w = weight[i]
        x = weight[j] if first + 1 < rows else 0.0
        y = weight[k] if first + 2 < rows else 0.0
        z = weight[m] if first + 3 < rows else 0.0
        for a in range(0, columns, 2):
            # A single last column is computed twice.
            c = min(a + 1, columns - 1)
            p, q, s, t = w * J[i, a], x * J[j, a], y * J[k, a], z * J[m, a]
            e, f, g, h = w * J[i, c], x * J[j, c], y * J[k, c], z * J[m, c]
            for b in range(min(columns, c // LANES * LANES + LANES)):  # the lower triangle, in whole vectors
                one, two, three, four = J[i, b], J[j, b], J[k, b], J[m, b]
                total = product[a, b] + (p * one + q * two + s * three + t * four)
                product[c, b] += e * one + f * two + g * three + h * four
                product[a, b] = total
            total = product[a, columns] + (p * r[i] + q * r[j] + s * r[k] + t * r[m])
            product[c, columns] += e * r[i] + f * r[j] + g * r[k] + h * r[m]
            product[a, columns] = total


_multiply: Callable[[Array, Array, Array, Array], None] = compiled(_loop, fastmath={"contract"})
