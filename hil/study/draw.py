"""The input of each run of a study: values drawn from its own random stream, inserted into the arm's TOML.

Run number i draws only from the stream (seed, i), so that its values do not depend on other runs or on the scheduling.
"""

from collections.abc import Iterator, Mapping
from itertools import product
from math import exp, log
from pathlib import Path
from typing import Any

import numpy as np

from hil.config.bundled import find_config
from hil.errors import ConfigError
from hil.fakes.description import found_beside
from hil.study.schema import Draw, Scalar, Study
from hil.toml_file import TomlFileError, load_toml


def run_count(study: Study) -> int:
    """Number of rows of the study. Raises ConfigError for a folder without recordings."""
    if study.study.task == "estimate":
        return len(recordings(study))
    if study.study.runs is not None:
        return study.study.runs
    return int(np.prod([len(values) for values in study.vary.values() if isinstance(values, list)], dtype=np.int64))


def drawn(study: Study, run: int) -> dict[str, Scalar]:
    """The varied values of run number `run`, by key."""
    if study.study.runs is None and study.study.task != "estimate":
        return _combination(study.vary, run)
    rng = np.random.default_rng([study.study.seed, run])
    return {key: _value(values, run, rng) for key, values in study.vary.items()}


def _combination(vary: Mapping[str, list[Scalar] | Draw], run: int) -> dict[str, Scalar]:
    lists = [values for values in vary.values() if isinstance(values, list)]
    for number, values in enumerate(product(*lists)):
        if number == run:
            return dict(zip(vary, values, strict=True))
    raise IndexError(run)


def _value(values: list[Scalar] | Draw, run: int, rng: np.random.Generator) -> Scalar:
    if isinstance(values, list):
        return values[run % len(values)]
    if values.count is not None:
        return values.count + run
    if values.uniform is not None:
        low, high = values.uniform
        return float(rng.uniform(low, high))
    if values.log_uniform is not None:
        low, high = values.log_uniform
        return exp(float(rng.uniform(log(low), log(high))))
    if values.normal is not None:
        mean, std = values.normal
        return float(rng.normal(mean, std))
    if values.integer is not None:
        return int(rng.integers(values.integer[0], values.integer[1] + 1))
    assert values.choice is not None  # Draw checks that one of them is given
    return values.choice[int(rng.integers(len(values.choice)))]


def arm_values(study: Study) -> dict[str, Any]:
    """The arm's TOML as a dictionary. Raises ConfigError."""
    path = arm_path(study)
    try:
        values = load_toml(path)
    except TomlFileError as error:
        raise ConfigError(f"{study.path}: study.config = {study.study.config!r}: {error}") from error
    for table in (values.get("arm"), values.get("fake", {}).get("chain")):
        if isinstance(table, dict) and isinstance(table.get("urdf"), str):
            # Each run's arm is written to another folder.
            table["urdf"] = str(found_beside(path.parent.absolute(), table["urdf"]))
    return values


def arm_path(study: Study) -> Path:
    """Path of the arm's TOML: relative to the study's folder, or a bundled file."""
    assert study.study.config is not None  # checked by the schema
    given = Path(study.study.config)
    beside = study.path.parent / given
    return beside if beside.exists() else find_config(given)


def put(values: dict[str, Any], key: str, value: Scalar) -> None:
    """Set `key`, such as "fake.arm.drives.0.coulomb", in `values`. Raises KeyError with the missing part of the key.

    A missing table is created; its names are validated later, when the arm is checked. A missing list entry is created
    only if the file lacks the whole list: "fake.faults.0.kind" creates the first fault.
    """
    *parents, last = key.split(".")
    place: Any = values
    for part, after in zip(parents, [*parents[1:], last], strict=True):
        place = _inside(place, part, after)
    if isinstance(place, list):
        _inside(place, last)
        place[int(last)] = value
    elif isinstance(place, dict):
        place[last] = value
    else:
        raise KeyError(last)


class _NewList(list[Any]):
    """A list that is not in the file and can therefore grow."""


def _inside(place: Any, part: str, after: str = "") -> Any:
    if isinstance(place, dict):
        return place.setdefault(part, _NewList() if after.isdigit() else {})
    if isinstance(place, _NewList) and part == str(len(place)):
        place.append({})
    if isinstance(place, list) and part.isdigit() and int(part) < len(place):
        return place[int(part)]
    raise KeyError(part)


def recordings(study: Study) -> list[Path]:
    """The run folders that hold a recording, sorted. Raises ConfigError if there are none."""
    assert study.study.recordings is not None  # checked by the schema
    given = Path(study.study.recordings)
    beside = study.path.parent / given
    folder = beside if beside.exists() else given
    found = sorted(_recorded(folder)) if folder.is_dir() else []
    if not found:
        raise ConfigError(f"{study.path}: study.recordings = {study.study.recordings!r}: no run folder in {folder}.")
    return found


def _recorded(folder: Path) -> Iterator[Path]:
    """Yield run folders. The steps of a pilot inside a run folder do not count as separate runs."""
    if (folder / "samples.npy").is_file() and (folder / "config.toml").is_file():
        yield folder
        return
    for below in folder.iterdir():
        if below.is_dir() and not below.is_symlink():
            yield from _recorded(below)
