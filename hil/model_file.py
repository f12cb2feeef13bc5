"""Read an `ArmModel` from a run folder, result.json or exported TOML/JSON. Standard library and numpy only."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from hil.arm_model import ArmModel
from hil.chain_model import ChainArmModel, Geometry
from hil.errors import ResultError
from hil.estimator.models.terms import RIGID_BODY, base_names, extra_names
from hil.next_step import command, only_steps, steps_of
from hil.results.json_form import FormError, from_json
from hil.results.parts import ArmFacts, ChainFacts, Quantity
from hil.results.result import SCHEMA, Result, SettledResult, result_from_json
from hil.toml_file import TomlFileError, parse_toml, read_toml_text


def _read(path: Path) -> dict[str, Any]:
    """The object in a run folder's result.json, or in the JSON or TOML file `path`. Raises ResultError."""
    file = _file(path)
    if path.is_dir() and not file.is_file():
        raise ResultError(_no_result(path))
    try:
        text = read_toml_text(file)
    except TomlFileError as error:
        raise ResultError(str(error)) from error
    try:
        result = parse_toml(text, file) if file.suffix.lower() == ".toml" else json.loads(text)
    except TomlFileError as error:
        raise ResultError(f"{error}\nRecreate it with hil export RUN --format toml.") from error
    except (ValueError, RecursionError) as error:
        if file.suffix.lower() != ".json":
            raise ResultError(
                f"{file} is not a hil model file. Give a run folder, its result.json, or a TOML or JSON file from "
                "hil export."
            ) from error
        raise ResultError(f"{file} is incomplete or damaged: {error}. Recreate it with hil estimate RUN.") from error
    if not isinstance(result, dict) or "schema" not in result:
        raise ResultError(f"{file} is not a hil result file: it has no schema.")
    if result["schema"] != SCHEMA:
        raise ResultError(
            f"{file}: schema is {result['schema']!r}, but this version of hil reads {SCHEMA}; the file was written by "
            f"{'a newer' if _newer(result['schema']) else 'another'} version. Install that version, or estimate again."
        )
    return result


def _no_result(folder: Path) -> str:
    if (folder / "samples.npy").is_file():
        return (
            f"{folder} has no result.json: its identification did not finish. Estimate it first: "
            f"{command('estimate', folder)}"
        )
    if steps := steps_of(folder):
        return only_steps(folder, steps)
    below = sorted(each.parent for each in folder.glob("*/result.json"))
    if below:
        listed = command("runs", folder)
        return f"{folder} is not a run folder but contains run folders: did you mean {below[-1]}? List them: {listed}"
    return (
        f"{folder} is not a run folder: it has neither a result nor a recording. {command('identify', 'ARM.toml')} "
        f"creates one; to list existing runs: {command('runs')}"
    )


def read_result(path: Path) -> Result:
    """Read the result in a run folder or a result.json. Raises ResultError."""
    try:
        return result_from_json(_read(path))
    except FormError as error:
        raise _damaged(path, error) from error


def read_settled_result(path: Path) -> SettledResult:
    """Read a result that was estimated from settled periods. Raises ResultError for any other result."""
    result = read_result(path)
    if not isinstance(result, SettledResult):
        raise ResultError(
            f"{path} was estimated by multiple shooting without a settled period; this command needs one."
        )
    return result


def read_model(path: str | PathLike[str]) -> ArmModel:
    """Read the identified arm of a run folder or file; see `hil.load_model`. Raises ResultError, TypeError."""
    if not isinstance(path, str | PathLike):
        raise TypeError(f"path must be a run folder or a file, not {path!r}.")
    try:
        saved = from_json(_SavedModel, _read(Path(path)))
    except FormError as error:
        raise _damaged(Path(path), error) from error
    return _model(saved.arm, {**saved.parameters, **saved.extra}, saved.chain, Path(path))


def read_usable_result(path: Path) -> Result:
    """Read a result that holds all the data needed for a model of the arm. Raises ResultError for any other result."""
    result = read_result(path)
    if result.arm is None:
        raise ResultError(
            f"{path} was estimated by multiple shooting without a settled period; this command needs one."
        )
    return result


def model_of(result: Result, path: Path) -> ArmModel:
    """Return the model of the arm in a result that was read from `path`. Raises ResultError."""
    if result.arm is None:
        raise ResultError(f"{path} holds no data about the arm's joints. Run hil estimate again.")
    return _model(result.arm, result.quantities, result.chain, path)


@dataclass(frozen=True)
class _SavedModel:
    """The parts of a result that a model needs; `hil export` also writes them."""

    arm: ArmFacts
    parameters: Mapping[str, Quantity]
    extra: Mapping[str, Quantity] = field(default_factory=dict)
    chain: ChainFacts | None = None


def _model(arm: ArmFacts, found: Mapping[str, Quantity], chain: ChainFacts | None, path: Path) -> ArmModel:
    values = {name: each.value for name, each in found.items()}
    stds = {name: each.std for name, each in found.items()}
    if chain is None:
        _check_terms(values, len(arm.joints), _file(path))
        return ArmModel(values, stds, arm.gravity, arm.rest_pose, arm.joints)
    geometry = Geometry(*(np.array(each) for each in (chain.rotation, chain.translation, chain.axis, chain.gravity)))
    _check_chain(values, geometry, chain, len(arm.joints), _file(path))
    return ChainArmModel(values, stds, arm.gravity, arm.rest_pose, arm.joints, geometry, dict(chain.groups))


def _check_chain(values: dict[str, float], geometry: Geometry, chain: ChainFacts, joints: int, path: Path) -> None:
    """Check that the geometry has the right number of joints and that no base parameter or friction term is missing."""
    shapes = tuple(each.shape for each in (geometry.rotation, geometry.translation, geometry.axis, geometry.gravity))
    if shapes != ((joints, 3, 3), (joints, 3), (joints, 3), (3,)):
        raise ResultError(f"{path} is damaged: the geometry of its {joints} joints has the shapes {shapes}.")
    friction = {f"{term}_{joint}" for term in ("viscous", "coulomb", "offset") for joint in range(1, joints + 1)}
    missing = sorted(({*chain.groups} | friction) - values.keys())
    if missing:
        raise ResultError(f"{path} is damaged: it lacks {', '.join(missing)}. Run hil estimate again.")
    bad = [name for name, value in values.items() if not math.isfinite(value)]
    if bad:
        raise ResultError(f"{path}: not a finite number: {', '.join(bad)}. Run hil estimate again.")


def _damaged(path: Path, error: FormError) -> ResultError:
    return ResultError(
        f"{_file(path)} is damaged or was written by an older version of hil: it {error}. Run hil estimate again."
    )


def _file(path: Path) -> Path:
    return path / "result.json" if path.is_dir() else path


def _check_terms(values: dict[str, float], joints: int, path: Path) -> None:
    """Check that every term is present and known: a model without one of its terms would be silently wrong."""
    if joints not in RIGID_BODY:
        raise ResultError(f"{path} describes an arm of {joints} joints; this version of hil supports one or two.")
    needed = set(base_names(joints))
    possible = {*needed, *extra_names(joints)}
    missing, unknown = sorted(needed - values.keys()), sorted(values.keys() - possible)
    if missing:
        raise ResultError(f"{path} is damaged: it lacks {', '.join(missing)}. Run hil estimate again.")
    if unknown:
        raise ResultError(
            f"{path} has {', '.join(unknown)}, which this version of hil does not know; a newer version wrote the file."
        )
    bad = [name for name, value in values.items() if not math.isfinite(value)]
    if bad:
        raise ResultError(f"{path}: not a finite number: {', '.join(bad)}. Run hil estimate again.")


def _newer(schema: object) -> bool:
    return isinstance(schema, int) and schema > SCHEMA
