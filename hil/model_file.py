"""From a run folder, result.json or exported TOML/JSON to an `ArmModel`. Standard library and numpy only."""

import json
import math
import tomllib
from os import PathLike
from pathlib import Path
from typing import Any

from hil.arm_model import ArmModel, JointFacts
from hil.errors import ResultError
from hil.estimator.models.terms import RIGID_BODY, base_names, extra_names

SCHEMA = 1


def read_result(path: Path) -> dict[str, Any]:
    """The result in a run folder, or in the JSON or TOML file `path`; raises ResultError."""
    file = path / "result.json" if path.is_dir() else path
    if path.is_dir() and not file.is_file():
        raise ResultError(
            f"{path} holds no result.json: its identification did not finish. If it holds samples.npy, run "
            f"hil estimate {path}."
        )
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise ResultError(f"{file}: cannot be read: {reason}.") from error
    try:
        result = tomllib.loads(text) if file.suffix == ".toml" else json.loads(text)
    except ValueError as error:
        raise ResultError(
            f"{file}: is half written or damaged: {error}. Make it anew with hil estimate RUN."
        ) from error
    if not isinstance(result, dict) or "schema" not in result:
        raise ResultError(f"{file}: is no result of hil: it has no schema.")
    if result["schema"] != SCHEMA:
        raise ResultError(
            f"{file}: schema {result['schema']!r} is not {SCHEMA}, which this hil reads; it was written by "
            f"{'a newer' if _newer(result['schema']) else 'another'} hil. Install that one, or estimate again."
        )
    return _with_infinities(result)


def _with_infinities(result: dict[str, Any]) -> dict[str, Any]:
    """An error bar that is infinite (nothing was seen of the parameter) is null in strict JSON."""
    for entry in [*result.get("parameters", {}).values(), *result.get("extra", {}).values()]:
        if isinstance(entry, dict) and entry.get("std", 0.0) is None:
            entry["std"] = math.inf
    covariance = result.get("covariance", {})
    if "matrix" in covariance:
        covariance["matrix"] = [[math.inf if each is None else each for each in row] for row in covariance["matrix"]]
    return result


def read_model(path: str | PathLike[str]) -> ArmModel:
    """See `hil.load_model`."""
    return model_of(read_result(Path(path)), Path(path))


def model_of(result: dict[str, Any], path: Path) -> ArmModel:
    """The model in a result that was read from `path`; raises ResultError."""
    file = path / "result.json" if path.is_dir() else path
    try:
        joints = tuple(_joint(entry) for entry in result["arm"]["joints"])
        gravity = float(result["arm"]["gravity"])
        rest_pose = tuple(float(angle) for angle in result["arm"]["rest_pose"])
        entries = {**result["parameters"], **result.get("extra", {})}
        values = {name: float(entry["value"]) for name, entry in entries.items()}
        stds = {name: float(entry["std"]) for name, entry in entries.items()}
    except (KeyError, TypeError, ValueError) as error:
        what = f"has no {error}" if isinstance(error, KeyError) else str(error)
        raise ResultError(f"{file}: is damaged or from an older hil: it {what}. Run hil estimate again.") from error
    _check_terms(values, len(joints), file)
    return ArmModel(values, stds, gravity, rest_pose, joints)


def _joint(entry: dict[str, Any]) -> JointFacts:
    low, high = entry["position_limit"]
    return JointFacts(
        name=str(entry["name"]),
        servo=str(entry["model"]),
        mode=str(entry["mode"]),
        torque_per_goal=float(entry["torque_per_goal"]),
        torque_per_goal_std=float(entry["torque_per_goal_std"]),
        goal_limit=float(entry["goal_limit"]),
        position_limit=(float(low), float(high)),
        velocity_limit=float(entry["velocity_limit"]),
    )


def _check_terms(values: dict[str, float], joints: int, path: Path) -> None:
    """Every term must be there and known: a model that left one out would be wrong without a word."""
    if joints not in RIGID_BODY:
        raise ResultError(f"{path}: an arm of {joints} joints; this hil has models of one and two.")
    needed = set(base_names(joints))
    possible = {*needed, *extra_names(joints)}
    missing, unknown = sorted(needed - values.keys()), sorted(values.keys() - possible)
    if missing:
        raise ResultError(f"{path}: is damaged: it lacks {', '.join(missing)}. Run hil estimate again.")
    if unknown:
        raise ResultError(f"{path}: has {', '.join(unknown)}, which this hil does not know; a newer one wrote it.")
    bad = [name for name, value in values.items() if not math.isfinite(value)]
    if bad:
        raise ResultError(f"{path}: {', '.join(bad)} is not a finite number. Run hil estimate again.")


def _newer(schema: object) -> bool:
    return isinstance(schema, int) and schema > SCHEMA
