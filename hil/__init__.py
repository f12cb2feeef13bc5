"""Identify the dynamics of servo arms: the experiment, its safety, its files and its command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from os import PathLike

    from hil.arm_model import ArmModel

__version__ = "0.1.0"


def load_model(path: str | PathLike[str]) -> ArmModel:
    """The identified arm of a run folder, of its result.json, or of a file that `hil export` wrote as TOML or JSON.

    Needs numpy only. Raises hil.errors.ResultError, which names the file and what is wrong with it: not there, half
    written, damaged, or from a newer hil.
    """
    from hil.model_file import read_model

    return read_model(path)
