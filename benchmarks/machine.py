"""Return the date and the machine of a measurement as one line."""

import os
import platform
from datetime import date


def machine() -> str:
    return f"{date.today()}, {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
