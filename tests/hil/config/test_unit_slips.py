"""Every number of the TOML files, a thousand times too large or too small, or in degrees.

The keys come from the models, so that a new one is tried too. A number that is refused names the unit in which it would
make sense and what to write; those that are accepted nevertheless, or refused without a unit, are listed.
"""

import copy
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from hil.config.recording import RecordingConfig
from hil.config.schema import Config
from hil.fakes.description import FakeArm
from hil.toml_errors import describe, fields_of, model_in
from hil.unit_hints import FRACTION, unit_of
from tests.support.paths import CONFIGS

FACTORS = {"x1000": 1000.0, "/1000": 1e-3, "x57.3": 57.29577951308232}

ARM = (
    (CONFIGS / "fake_two_link.toml").read_text(encoding="utf-8").split("\n[fake]")[0].replace("fake://", "/dev/ttyUSB0")
)
WHOLE_ARM = """
[arm.prior]
spread = 0.3
rough_spread = 0.5
link_mass = [0.2, 0.2]
link_centre = [0.08, 0.1]
link_inertia = [0.0007, 0.0003]
servo_mass = [0.082, 0.082]
armature = [0.01, 0.01]
viscous = [0.045, 0.04]
coulomb = [0.055, 0.05]
[stabiliser]
stiffness = [2.0, 1.0]
damping = [0.1, 0.05]
[known]
length_1 = 0.147
mass_1 = 0.2
centre_1 = 0.08
link_inertia_1 = 0.0007
armature_1 = 0.01
mass_elbow = 0.082
mass_2 = 0.2
centre_2 = 0.1
link_inertia_2 = 0.0003
rotor_inertia_2 = 2e-7
gear_ratio_2 = 353.5
"""
PWM = '[[joints]]\nname = "only"\nid = 1\nmodel = "XL430-W250"\nzero_ticks = 2048\ntorque_per_volt = 0.12\n' + (
    "torque_per_volt_std = 0.02\nposition_limit = [-3.1, 0.0]\nvelocity_limit = 6.0\nvoltage_limit = 5.0\n"
)
SPATIAL = (
    (CONFIGS / "fake_open_manipulator_x.toml")
    .read_text(encoding="utf-8")
    .split("\n[fake]")[0]
    .replace("fake://", "/dev/ttyUSB0")
)
COLUMNS = """
[columns]
rate = 200.0
position = ["a", "b"]
zero = [-1.5708, 0.7]
position_step = 0.00153
torque_constant = [1.8, 1.8]
supply_voltage = 12.0
resistance = [5.0, 5.0]
torque_per_volt = [0.3, 0.3]
pwm = ["c", "d"]
"""
FAKE = (CONFIGS / "fake_two_link.toml").read_text(encoding="utf-8").split("\n[fake]", 1)[1]

NAMED, OTHER, REFUSED, ACCEPTED = "named", "another value", "refused", "accepted"
UNITS_OF_KNOWN = {
    "length": "m", "mass": "kg", "mass_elbow": "kg", "centre": "m", "link_inertia": "kg m^2", "armature": "kg m^2",
    "rotor_inertia": "kg m^2",
}  # fmt: skip
LEFT_OUT: dict[str, tuple[str, ...]] = {
    "arm": ("columns", "joints.torque_per_volt", "joints.voltage_limit", "known.armature_2", "known.rotor_inertia_1"),
    "pwm": ("columns", "joints.torque_constant", "joints.current_limit", "arm.prior", "known", "safety", "experiment"),
    "spatial": ("columns", "arm.prior", "arm.link_lengths", "joints", "experiment", "safety", "known"),
    "columns": ("known",),
    "fake": ("arm.drives.coulomb_width",),  # excludes presliding, which is tried
    "chain": ("chain.drives", "servos"),
}
"""Keys that do not belong in that file, or are tried in another one."""
EXCEPTIONS: dict[str, dict[str, str]] = {
    "arm": {
        "experiment.rate x1000": REFUSED,  # nobody gives a rate in mHz
        "joints.torque_constant /1000": OTHER,
        "joints.position_limit /1000": REFUSED,
        "joints.current_limit /1000": OTHER,
        "arm.link_lengths /1000": REFUSED,
        "arm.prior.viscous x57.3": ACCEPTED,
        "experiment.period /1000": REFUSED,
        "experiment.band /1000": REFUSED,
        "safety.watchdog /1000": REFUSED,
        "safety.rest_velocity x1000": OTHER,
        "safety.limit_chance x100": ACCEPTED,
        "stabiliser.stiffness x57.3": OTHER,
        "stabiliser.damping x57.3": ACCEPTED,
        "known.link_inertia_2 x1000": ACCEPTED,
    },
    "pwm": {
        "joints.torque_per_volt /1000": OTHER,
        "joints.position_limit /1000": REFUSED,
        "joints.voltage_limit /1000": OTHER,
        "arm.link_lengths /1000": REFUSED,
    },
    "spatial": {
        "joint_path.centre x1000": OTHER,
        "joint_path.speed x1000": OTHER,
        "stabiliser.stiffness x57.3": OTHER,
        "stabiliser.damping x57.3": OTHER,
    },
    "columns": {
        "columns.rate x1000": REFUSED,
        "columns.position_step x1000": OTHER,
    },
    "fake": {
        "adapter_latency_us x1000": ACCEPTED,
        "servos.current_noise_a x1000": ACCEPTED,
        "servos.encoder.noise_ticks x1000": ACCEPTED,
        "servos.encoder.twice_ticks x1000": ACCEPTED,
        "servos.clock_error_ppm x1000": ACCEPTED,
        "servos.overload.time_s x1000": ACCEPTED,
        "arm.links.inertia x1000": ACCEPTED,
        "arm.drives.rotor_inertia x1000": ACCEPTED,
        "arm.drives.viscous x57.3": ACCEPTED,
        "arm.drives.stribeck_velocity x1000": OTHER,
        "arm.drives.presliding_stiffness x57.3": ACCEPTED,
        "arm.drives.presliding_damping x57.3": ACCEPTED,
        "arm.drives.offset x1000": ACCEPTED,
        "arm.drives.cable_stiffness x57.3": ACCEPTED,
        "arm.drives.cable_angle x1000": OTHER,
        "arm.drives.cogging x1000": ACCEPTED,
        "arm.drives.backlash x1000": OTHER,
        "arm.drives.gear_stiffness x57.3": ACCEPTED,
        "arm.drives.gear_damping x1000": ACCEPTED,
        "arm.drives.gear_damping x57.3": ACCEPTED,
        "arm.drives.stops /1000": REFUSED,
        "arm.drives.stop_stiffness x1000": ACCEPTED,
        "arm.drives.stop_stiffness x57.3": ACCEPTED,
        "arm.drives.stop_damping x1000": ACCEPTED,
        "arm.drives.stop_damping x57.3": ACCEPTED,
        "faults.at x1000": ACCEPTED,
        "faults.duration x1000": ACCEPTED,
        "moves.to x1000": OTHER,
        "moves.at x1000": ACCEPTED,
        "moves.duration x1000": ACCEPTED,
        "moves.hold x1000": ACCEPTED,
    },
    "chain": {
        "adapter_latency_us x1000": ACCEPTED,
        "chain.base x1000": OTHER,
        "chain.centre_shift x1000": OTHER,
    },
}

SAMPLES = {
    "gravity": 9.81, "rest_tolerance": 0.5, "link_lengths": [0.147, 0.18], "warm_up": 60.0, "min_voltage": 9.5,
    "tilt": 0.3, "start": [-1.57, 0.5], "cable_angle": 0.4, "stops": [-3.2, 1.8], "brownout_v": 6.0,
    "input_voltage_v": 12.0, "current_noise_a": 0.005, "noise_ticks": 0.3, "once_ticks": 1.5, "once_phase": 0.6,
    "twice_ticks": 0.8, "twice_phase": -1.1, "clock_error_ppm": 20.0, "resistance_k_w": 8.0, "time_s": 400.0,
    "current_a": 1.5, "resistance_ohm": 0.4, "at": 3.0, "duration": 0.5, "probability": 0.2, "to": 0.4, "hold": 2.0,
    "centre": [0.2, 0.3, 0.4], "size": [0.2, 0.3, 0.4], "turned": [0.1, 0.2, 0.5], "floor": -0.05, "margin": 0.01,
    "base": [0.1, 0.2, 0.5], "offset": 0.004, "coulomb_width": 0.02, "cold_viscous": 0.3, "cold_coulomb": 0.3,
    "load": 0.05, "ripple": 0.02, "cogging": 0.01, "backlash": 0.01, "presliding_stiffness": 300.0,
    "presliding_damping": 0.5, "cable_stiffness": 0.2, "current_lag": 0.001, "saturation": 0.05, "rest": 0.5,
    "damp_time": 0.06, "torque_constant_std": 0.15, "adapter_latency_us": 60.0, "centre_shift": [0.01] * 5,
    "payload": 0.3, "payload_at": [0.05, 0.01, 0.02],
}  # fmt: skip
"""Sane values where the file gives none and the default is missing or 0."""


def _documents() -> dict[str, tuple[type[BaseModel], dict[str, Any]]]:
    """Complete files by name: the model that checks them, and their tables."""
    arm = tomllib.loads(ARM + WHOLE_ARM)
    pwm = tomllib.loads(ARM) | {"joints": tomllib.loads(PWM)["joints"] * 1}
    pwm["arm"] = {**pwm["arm"], "rest_pose": [-1.5708], "link_lengths": [0.147]}
    pwm["experiment"] = {**pwm["experiment"], "peak_torque": [0.3]}
    spatial = tomllib.loads(SPATIAL)
    spatial["arm"]["urdf"] = str(CONFIGS / spatial["arm"]["urdf"])
    spatial["clearance"]["boxes"] = [{"name": "box", "centre": [0.2, 0.3, 0.4], "size": [0.2, 0.3, 0.4]}]
    fake = tomllib.loads("[fake]" + FAKE)["fake"]
    fake["servos"][0] |= {"thermal": {"resistance_k_w": 8.0, "time_s": 400.0}, "encoder": {}}
    fake["servos"][0] |= {"overload": {"current_a": 1.5, "time_s": 2.0}}
    fake |= {"supply": {"resistance_ohm": 0.4}, "faults": [{"kind": "noise", "at": 3.0}]}
    fake |= {"moves": [{"servo": 1, "to": 0.4}]}
    fake["arm"]["drives"][0] |= {"presliding_stiffness": 300.0, "presliding_damping": 0.5}
    chain = tomllib.loads((CONFIGS / "fake_open_manipulator_x.toml").read_text(encoding="utf-8"))["fake"]
    chain["chain"]["urdf"] = str(CONFIGS / chain["chain"]["urdf"])
    return {
        "arm": (Config, arm),
        "pwm": (Config, pwm),
        "spatial": (Config, spatial),
        "columns": (RecordingConfig, tomllib.loads(COLUMNS)),
        "fake": (FakeArm, fake),
        "chain": (FakeArm, {key: chain[key] for key in ("servos", "chain")}),
    }


def _numbers(model: Any, table: Any, where: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any, str | None]]:
    """Yield the place of every key that takes a number, a sane value of it, and its unit."""
    for key, field in fields_of(model).items():
        inner, value = model_in(field.annotation), table.get(key)
        if "float" in str(field.annotation) or "PositiveFloat" in str(field.annotation):
            sane = value or SAMPLES.get(key) or (None if field.is_required() else field.default)
            yield (*where, key), sane, UNITS_OF_KNOWN.get(key.rstrip("_12"), unit_of(field.description))
        elif isinstance(value, list | tuple) and inner is not None:
            yield from _numbers(inner, value[0], (*where, key, 0))
        elif inner is not None and (value is not None or not _needs(inner)):
            yield from _numbers(inner, value or {}, (*where, key))


def _needs(model: Any) -> bool:
    """Whether a table has required keys, so that it is only tried if it is written out."""
    return any(field.is_required() for field in model.model_fields.values())


def _said(model: type[BaseModel], tables: dict[str, Any]) -> str:
    try:
        model.model_validate(tables | ({"path": Path("arm.toml")} if model is Config else {}))
    except ValidationError as error:
        return describe(error, "arm.toml", model)
    return ""


def _with(tables: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    changed = copy.deepcopy(tables)
    table: Any = changed
    for part in place[:-1]:
        table = table[part] if isinstance(part, int) else table.setdefault(part, {})
    table[place[-1]] = value
    return changed


def _times(value: Any, factor: float) -> Any:
    return [each * factor for each in value] if isinstance(value, list | tuple) else value * factor


def _outcome(said: str, sane: Any) -> str:
    if not said:
        return ACCEPTED
    proposals = [float(each) for each in re.findall(r"write \[?(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)", said)]
    values = sane if isinstance(sane, list | tuple) else [sane]
    if any(each == pytest.approx(value, rel=0.01) for each in proposals for value in values):
        return NAMED
    return OTHER if proposals else REFUSED


def _table(name: str) -> dict[str, str]:
    """Outcome of every slip of one file, by key and factor; without those that were named or merely made small."""
    model, tables = _documents()[name]
    assert _said(model, tables) == ""
    outcomes = {}
    for place, sane, unit in _numbers(model, tables):
        key = ".".join(str(part) for part in place if not isinstance(part, int))
        if unit is None or key.startswith(LEFT_OUT[name]) or isinstance(sane, bool | str):
            continue
        assert sane is not None, f"{key}: give a sane value in SAMPLES"
        assert _said(model, _with(tables, place, sane)) == "", key
        factors = {"x100": 100.0} if unit == FRACTION else FACTORS
        for factor in factors if "rad" in unit or unit == FRACTION else ("x1000", "/1000"):
            said = _said(model, _with(tables, place, _times(sane, factors[factor])))
            outcome = _outcome(said, sane)
            if outcome != NAMED and (factor, outcome) != ("/1000", ACCEPTED):
                outcomes[f"{key} {factor}"] = outcome
    return outcomes


@pytest.mark.parametrize("name", sorted(EXCEPTIONS))
def test_a_refused_number_names_the_unit_in_which_it_makes_sense(name: str) -> None:
    assert _table(name) == EXCEPTIONS[name]
