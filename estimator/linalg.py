"""numpy's linear algebra, with its failures raised as errors of the estimator.

Matrices that are not finite, because a simulated motion diverged or a parameter lost its effect, make decompositions
fail with numpy's LinAlgError. The estimator's callers do not handle that error: a search over models would stop with a
traceback instead of trying the next model. Therefore `hil.estimator` and `hil.estimation` take these functions from
here.
"""

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

from hil.estimator.errors import ConvergenceError

__all__ = [
    "cholesky",
    "cond",
    "eigh",
    "eigvalsh",
    "inv",
    "lstsq",
    "matrix_rank",
    "pinv",
    "polyfit",
    "qr",
    "solve",
    "svd",
]

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def _guarded(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return `function` with LinAlgError replaced by ConvergenceError."""

    @wraps(function)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            return function(*args, **kwargs)
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(
                f"the equations of the fit cannot be solved ({error}): a simulated motion diverges, or the motion says "
                "nothing about some parameter. Check the units and signs of torque and angle, and whether the arm was "
                "the same throughout the recording"
            ) from error

    return guarded


if TYPE_CHECKING:
    from numpy.linalg import cholesky, cond, eigh, eigvalsh, inv, lstsq, matrix_rank, pinv, qr, solve, svd
    from numpy.polynomial.polynomial import polyfit
else:
    cholesky, cond, eigh = _guarded(np.linalg.cholesky), _guarded(np.linalg.cond), _guarded(np.linalg.eigh)
    eigvalsh, inv, lstsq = _guarded(np.linalg.eigvalsh), _guarded(np.linalg.inv), _guarded(np.linalg.lstsq)
    matrix_rank, pinv, qr = _guarded(np.linalg.matrix_rank), _guarded(np.linalg.pinv), _guarded(np.linalg.qr)
    solve, svd, polyfit = _guarded(np.linalg.solve), _guarded(np.linalg.svd), _guarded(np.polynomial.polynomial.polyfit)
