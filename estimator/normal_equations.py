"""The products of least squares, taken so that no BLAS spreads them over threads of its own.

Those threads spin: beside ours, or on a busy machine, they make small products ten times slower, and the
last digits would depend on their number.
"""

import numpy as np

from estimator.arrays import Array

BLOCK = 64  # rows: too few for a BLAS to share out


def normal_equations(jacobian: Array, residual: Array) -> tuple[Array, Array]:
    """J'J (columns, columns) and J'r (columns,) of J (rows, columns) and r (rows,)."""
    both = np.column_stack((jacobian, residual))
    padded = np.concatenate((both, np.zeros((-len(both) % BLOCK, both.shape[1]))))
    blocks = padded.reshape(-1, BLOCK, both.shape[1])
    product = np.matmul(np.ascontiguousarray(blocks.transpose(0, 2, 1)), blocks).sum(axis=0)
    return product[:-1, :-1], product[:-1, -1]


def sum_of_squares(residual: Array) -> float:
    """|r|^2 of r (rows,)."""
    return float(np.sum(np.square(residual)))
