"""numpy's linear algebra and scipy's least squares for the estimator, with failures raised as estimator errors.

Matrices that are not finite, because a simulated motion diverged or a parameter lost its effect, make decompositions
fail with numpy's LinAlgError. With that error, a search over models would stop with a traceback instead of trying the
next model. Therefore `hil.estimator` and `hil.estimation` take these functions from here.
"""

import re
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
    "least_squares",
    "lstsq",
    "matrix_rank",
    "pinv",
    "polyfit",
    "qr",
    "solve",
    "svd",
]

NOT_FINITE = re.compile(r"not finite|infs or NaNs")
"""Text in scipy's ValueErrors about non-finite values; any other ValueError is due to a wrong call."""

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def _guarded(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Wrap `function` so that errors caused by the data rather than by a wrong call become ConvergenceErrors."""

    @wraps(function)
    def guarded(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        try:
            return function(*args, **kwargs)
        except (np.linalg.LinAlgError, ValueError) as error:
            if not isinstance(error, np.linalg.LinAlgError) and not NOT_FINITE.search(str(error)):
                raise
            raise ConvergenceError(
                f"the equations of the fit cannot be solved ({error}): a simulated motion diverges, or the motion "
                "provides no information about some parameter. Check the units and signs of torque and angle, and "
                "whether the arm was the same throughout the recording"
            ) from error

    return guarded


if TYPE_CHECKING:
    from numpy.linalg import cholesky, cond, eigh, eigvalsh, inv, lstsq, matrix_rank, pinv, qr, solve, svd
    from numpy.polynomial.polynomial import polyfit
    from scipy.optimize import least_squares
else:

    @_guarded
    def least_squares(*args, **kwargs):
        from scipy.optimize import least_squares  # slow to import, and few estimates need it

        return least_squares(*args, **kwargs)

    cholesky, cond, eigh = _guarded(np.linalg.cholesky), _guarded(np.linalg.cond), _guarded(np.linalg.eigh)
    eigvalsh, inv, lstsq = _guarded(np.linalg.eigvalsh), _guarded(np.linalg.inv), _guarded(np.linalg.lstsq)
    matrix_rank, pinv, qr = _guarded(np.linalg.matrix_rank), _guarded(np.linalg.pinv), _guarded(np.linalg.qr)
    solve, svd, polyfit = _guarded(np.linalg.solve), _guarded(np.linalg.svd), _guarded(np.polynomial.polynomial.polyfit)
