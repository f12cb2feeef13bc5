"""BLAS on one thread, where its products are small and many.

Its own threads spin while they wait: on two cores with other work a singular value decomposition of 1200 by 16 took
30 ms on two threads and 0.6 ms on one (docs/dependencies.md).
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def one_blas_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """`function` with BLAS held to one thread while it runs, in the whole process; calls may be nested."""

    @wraps(function)
    def held(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return held
