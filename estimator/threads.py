"""How many threads independent work may take."""

import os

VARIABLE = "HIL_THREADS"


def thread_count(most: int | None = None) -> int:
    """One for each core, or as many as the environment variable HIL_THREADS says, and not more than `most`.

    Results do not depend on it. A process that shares its machine with others of its kind is given one.
    """
    told = os.environ.get(VARIABLE, "")
    count = int(told) if told.isdigit() and int(told) > 0 else os.cpu_count() or 1
    return count if most is None else min(count, most)
