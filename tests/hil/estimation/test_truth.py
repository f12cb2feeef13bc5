"""True values of a fake arm, scaled like a result to the torque constants of the file."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from hil.config.schema import Config
from hil.estimation.comparison import compare
from hil.estimation.comparison.compare import compare_run, truth_for
from hil.estimation.truth import scaled, truth_of
from hil.estimator.baselines.compare import Peer
from hil.model_file import read_settled_result
from hil.report.run_data import RunData
from hil.report.sections.verdict import verdict
from hil.results.parts import Quantity
from hil.results.result import SettledResult
from hil.runs.run_folder import RunFolder


def stronger(config: Config, factors: tuple[float, ...]) -> Config:
    """The file with other torque constants than the fake arm's motors."""
    joints = [
        joint.model_copy(update={"torque_constant": joint.torque_per_goal * factor})
        for joint, factor in zip(config.joints, factors, strict=True)
    ]
    return config.model_copy(update={"joints": joints})


@pytest.fixture(scope="module")
def result(identified_once: Path) -> SettledResult:
    return read_settled_result(identified_once)


def test_equal_constants_leave_the_truth_as_it_is(result: SettledResult, identified_once: Path) -> None:
    truth = truth_of(result, RunFolder.open(identified_once).load_config())
    assert truth.values == result.truth and truth.note == ""


def test_one_factor_scales_every_value(result: SettledResult, identified_once: Path) -> None:
    config = RunFolder.open(identified_once).load_config()
    truth = truth_of(result, stronger(config, (1.06, 1.06)))
    assert result.truth is not None
    assert truth.values == pytest.approx({name: 1.06 * value for name, value in result.truth.items()})
    assert "shoulder -5.7 %, elbow -5.7 %" in truth.note


def test_what_both_joints_determine_has_no_unit_if_their_constants_differ(
    result: SettledResult, identified_once: Path
) -> None:
    config = stronger(RunFolder.open(identified_once).load_config(), (1.06, 1.0))
    truth = truth_of(result, config)
    assert set(result.truth or {}) - set(truth.values) == {"coupling", "inertia_2", "gravity_2"}
    assert truth.values["gravity_1"] == pytest.approx(1.06 * (result.truth or {})["gravity_1"])
    assert truth.values["viscous_2"] == (result.truth or {})["viscous_2"]
    assert "are not shown" in truth.note
    ratio = {**result.extra, "torque_scale_2": Quantity(1.06, 1e-3, "1")}
    whole = truth_of(dataclasses.replace(result, extra=ratio), config)
    assert whole.values == pytest.approx({name: 1.06 * value for name, value in (result.truth or {}).items()})


def test_a_result_holds_the_truth_in_its_own_unit_too(result: SettledResult, identified_once: Path) -> None:
    config = RunFolder.open(identified_once).load_config()
    assert result.truth_scaled is None
    found = scaled(result.truth, stronger(config, (1.06, 1.06)), result.extra)
    assert found == pytest.approx({name: 1.06 * value for name, value in (result.truth or {}).items()})
    assert scaled(None, config, {}) is None


def test_compare_judges_each_method_in_its_own_unit(result: SettledResult, identified_once: Path) -> None:
    config = stronger(RunFolder.open(identified_once).load_config(), (1.06, 1.0))
    peer = Peer("hil", result.values, {}, 0.0, "", 1)
    alone = truth_for(peer, result.truth, config)
    assert alone is not None and alone["viscous_1"] == pytest.approx(1.06 * (result.truth or {})["viscous_1"])
    with_ratio = dataclasses.replace(peer, parameters={**peer.parameters, "torque_scale_2": 1.06})
    every = truth_for(with_ratio, result.truth, config)
    assert every == pytest.approx({name: 1.06 * value for name, value in (result.truth or {}).items()})


def test_compare_shows_a_planar_arms_truth_in_the_unit_of_the_file(
    result: SettledResult, identified_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(identified_once, tmp_path / "run")
    run = RunFolder.open(tmp_path / "run")
    config = stronger(run.load_config(), (1.06, 1.06))
    monkeypatch.setattr(run, "load_config", lambda: config)
    ours = Peer("hil", {name: 1.06 * value for name, value in (result.truth or {}).items()}, {}, 0.0, "", 1)
    monkeypatch.setattr(compare, "all_methods", lambda *_: [ours])
    found = compare_run(run, False)
    assert found.truth == pytest.approx(ours.parameters)
    assert found.methods["hil"].worst_relative_error == pytest.approx(0.0, abs=1e-9)


def test_a_value_near_zero_does_not_head_the_relative_errors(identified_once: Path) -> None:
    data = RunData.load(identified_once)
    found = {name: Quantity(value, 1e-3 * abs(value), "1") for name, value in (data.result.truth or {}).items()}
    found["offset_1"] = Quantity(6e-4, 3e-4, "N m")
    found["gravity_1"] = dataclasses.replace(found["gravity_1"], value=1.005 * found["gravity_1"].value)
    truth = {**(data.result.truth or {}), "offset_1": 1e-5}
    changed = dataclasses.replace(data, result=dataclasses.replace(data.result, parameters=found, truth=truth))
    (said,) = [each for each in verdict(changed).bullets if "known true parameters" in each]
    assert said.endswith("5.0 standard errors (gravity_1), and 0.5 % among the well-determined values (gravity_1).")
