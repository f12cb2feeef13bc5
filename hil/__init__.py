"""Identify the dynamics of servo arms: experiments, safety, files, command line and Python functions.

    import hil

    result = hil.identify("fake_two_link")
    result.parameters["inertia_1"].value

Each function named after a command does the same as that command. The functions are loaded on first use, so that
`import hil` takes almost no time.
"""

from __future__ import annotations

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from os import PathLike

    from hil.api.check import CheckReport, check
    from hil.api.dry_run import Rehearsal, dry_run
    from hil.api.estimate import estimate
    from hil.api.experiment import identify, record
    from hil.api.progress import Progress
    from hil.api.run import Estimation, Identification, Run, load_run
    from hil.arm_model import ArmModel
    from hil.config.schema import Config, load_config
    from hil.errors import HilError

__all__ = [
    "ArmModel",
    "CheckReport",
    "Config",
    "Estimation",
    "HilError",
    "Identification",
    "Progress",
    "Rehearsal",
    "Run",
    "check",
    "dry_run",
    "estimate",
    "identify",
    "load_config",
    "load_model",
    "load_run",
    "record",
]

__version__ = "0.1.0"

_HOME = {
    "ArmModel": "hil.arm_model",
    "CheckReport": "hil.api.check",
    "Config": "hil.config.schema",
    "Estimation": "hil.api.run",
    "HilError": "hil.errors",
    "Identification": "hil.api.run",
    "Progress": "hil.api.progress",
    "Rehearsal": "hil.api.dry_run",
    "Run": "hil.api.run",
    "check": "hil.api.check",
    "dry_run": "hil.api.dry_run",
    "estimate": "hil.api.estimate",
    "identify": "hil.api.experiment",
    "load_config": "hil.config.schema",
    "load_run": "hil.api.run",
    "record": "hil.api.experiment",
}

# A library logs nothing unless the user enables it: logging.basicConfig(level=logging.INFO).
logging.getLogger("hil").addHandler(logging.NullHandler())


def load_model(path: str | PathLike[str]) -> ArmModel:
    """Read the identified arm from a run folder, its result.json, or a TOML or JSON file written by `hil export`.

    Requires only numpy. Raises hil.errors.ResultError; its message names the file and says whether it is missing,
    incomplete, damaged, or written by a newer version of hil.
    """
    from hil.model_file import read_model

    return read_model(path)


def __getattr__(name: str) -> Any:
    """Load a function or class of `__all__` on first use."""
    if name not in _HOME:
        raise AttributeError(f"module 'hil' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOME[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
