"""The date and machine of a measurement on one line."""

import os
import platform
from datetime import date


def machine() -> str:
    return f"{date.today()}, {platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
