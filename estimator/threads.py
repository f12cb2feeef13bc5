"""Number of threads for independent work."""

import os

VARIABLE = "HIL_THREADS"


def thread_count(most: int | None = None) -> int:
    """Return the number of CPU cores, or the value of the environment variable HIL_THREADS, but at most `most`.

    Results do not depend on this number. Set HIL_THREADS to 1 for processes that run in parallel.
    """
    told = os.environ.get(VARIABLE, "")
    count = int(told) if told.isdigit() and int(told) > 0 else os.cpu_count() or 1
    return count if most is None else min(count, most)
