"""BLAS limited to one thread, for computations with many small products.

BLAS threads spin while they wait: on two busy cores, a singular value decomposition of a 1200 by 16 matrix took 30 ms
with two threads and 0.6 ms with one (docs/dependencies.md).
"""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def one_blas_thread(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return `function` with BLAS limited to one thread in the whole process while it runs; calls may be nested."""

    @wraps(function)
    def held(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return held
