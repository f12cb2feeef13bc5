"""Results of slow, pure functions that several tests or runs need: each is computed once per process."""

import pickle
from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Result = TypeVar("Result")


def remembered(function: Callable[Given, Result]) -> Callable[Given, Result]:
    """Return a version of `function` that remembers its results; `function` must be pure.

    Arguments and results may be anything that can be pickled. Unlike `functools.cache`, this accepts arrays, and each
    caller gets its own copy of the result.
    """
    results: dict[bytes, bytes] = {}

    @wraps(function)
    def recalled(*args: Given.args, **kwargs: Given.kwargs) -> Result:
        key = pickle.dumps((args, sorted(kwargs.items())))
        if key not in results:
            results[key] = pickle.dumps(function(*args, **kwargs))
        result: Result = pickle.loads(results[key])
        return result

    return recalled
