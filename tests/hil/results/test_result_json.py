"""Conversion between result.json and the frozen results is lossless, and damage is reported."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil import strict_json
from hil.errors import ResultError
from hil.model_file import read_result, read_settled_result
from hil.results.json_form import FormError, from_json, to_json
from hil.results.parts import Covariance, ModelChoice, Quantity, ShootingFit, Timing, TriedModel, Zeros
from hil.results.result import SettledResult, ShootingResult, result_from_json

NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
ERRORS = st.floats(min_value=0.0, allow_nan=False)  # infinite if there is no information


@st.composite
def shooting_results(draw: st.DrawFn) -> ShootingResult:
    names = draw(st.lists(st.sampled_from(["inertia_1", "gravity_1", "viscous_1", "lag"]), min_size=1, unique=True))
    found = {name: Quantity(draw(NUMBERS), draw(ERRORS), draw(st.sampled_from(["N m", "1"]))) for name in names}
    matrix = tuple(tuple(draw(ERRORS) for _ in names) for _ in names)
    tried = TriedModel("coulomb + lag", 5, draw(st.none() | st.just((0.1,))), draw(st.none() | NUMBERS), 0.5)
    return ShootingResult(
        method="multiple shooting",
        config="arm.toml",
        joints=1,
        parameters=found,
        extra={},
        covariance=Covariance(tuple(names), matrix),
        fit=ShootingFit(residual_rms_ticks=(0.3,), residual_rms_rad=(draw(NUMBERS),), samples=9, segments=2),
        warnings=tuple(draw(st.lists(st.text(), max_size=2))),
        model_choice=draw(st.none() | st.just(ModelChoice(chosen="coulomb", error_divided_by=1.0, tried=(tried,)))),
        timing=Timing(estimation_seconds=1.0),
        zeros=draw(st.none() | st.just((Zeros(zero=(0.1,), std=(math.inf,), recording="a.csv"),))),
        recordings=("a.csv",),
    )


@settings(max_examples=40)
@given(shooting_results())
def test_any_result_comes_back_from_strict_json_as_it_was(result: ShootingResult) -> None:
    assert result_from_json(json.loads(strict_json.dumps(result.to_json()))) == result


def test_a_runs_result_is_its_file_key_for_key(identified_once: Path) -> None:
    text = (identified_once / "result.json").read_text(encoding="utf-8")
    result = read_settled_result(identified_once)
    assert strict_json.dumps(result.to_json(), indent=2) + "\n" == text
    assert list(result.quantities) == list(result.covariance.names)
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.joints = 3  # type: ignore[misc]


def test_keys_of_a_newer_hil_are_ignored_and_later_ones_may_be_missing(identified_once: Path) -> None:
    raw = json.loads((identified_once / "result.json").read_text(encoding="utf-8"))
    result = result_from_json(raw)
    raw["colour"] = {"of": "the arm"}
    raw["fit"]["luck"] = 0.5
    raw["parameters"]["inertia_1"]["skew"] = 0.0
    assert result_from_json(raw) == result
    for key in ("correlation_time", "outliers", "model"):
        del raw["fit"][key]
    del raw["validation"]["line_levels_ticks"], raw["warnings"]
    older = result_from_json(raw)
    assert isinstance(older, SettledResult) and older.fit.outliers == 0 and older.warnings == ()


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("fit",), None, "it has no 'fit'"),
        (("parameters", "inertia_1", "value"), None, "has no 'parameters.inertia_1.value'"),
        (("parameters", "inertia_1", "value"), "much", "has 'much' as 'parameters.inertia_1.value'"),
        (("parameters", "inertia_1", "std"), -0.1, "has -0.1 as 'parameters.inertia_1.std', which cannot be negative"),
        (("covariance", "matrix"), [[-1e-6]], "has a negative variance of 'inertia_1' in its covariance"),
        (("joints",), True, "has True as 'joints'"),
        (("arm", "rest_pose"), {"a": 1}, "as 'arm.rest_pose'"),
        (("arm", "joints"), [{"name": "one"}], "has no 'arm.joints[0].model'"),
        (("covariance", "names"), ["inertia_9"], "has 'inertia_9' in its covariance"),
        (("verdict",), None, "has no 'verdict'"),
    ],
)
def test_damage_is_named(identified: Path, path: tuple[str, ...], value: Any, said: str) -> None:
    file = identified / "result.json"
    raw = json.loads(file.read_text(encoding="utf-8"))
    table = raw
    for key in path[:-1]:
        table = table[key]
    if value is None:
        del table[path[-1]]
    else:
        table[path[-1]] = value
    file.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(ResultError) as caught:
        read_result(identified)
    message = str(caught.value)
    assert message.startswith(f"{file} is damaged or was written by an older version of hil: it ")
    assert said in message


def test_a_pair_needs_two_entries() -> None:
    @dataclasses.dataclass(frozen=True)
    class Range:
        limits: tuple[float, float]

    assert from_json(Range, {"limits": [1, 2.5]}) == Range((1.0, 2.5))
    with pytest.raises(FormError, match="has 3 entries instead of 2 in 'limits'"):
        from_json(Range, {"limits": [1, 2, 3]})
    assert to_json(Range((1.0, 2.0))) == {"limits": [1.0, 2.0]}


@settings(max_examples=40)
@given(shooting_results())
def test_a_result_without_encoder_steps_shows_its_residual_as_an_angle(result: ShootingResult) -> None:
    assert "residual 0.300 encoder steps RMS" in repr(result)
    stepless = dataclasses.replace(result, fit=dataclasses.replace(result.fit, residual_rms_ticks=()))
    assert "mrad RMS" in repr(stepless) and "encoder steps" not in repr(stepless)
