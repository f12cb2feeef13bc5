"""Recordings of a spatial arm by other tools: motion that is not periodic, with its URDF."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import hil as api
from benchmarks import chain as bench
from hil.config.recording import parse_recording_config
from hil.errors import ConfigError, CsvError
from hil.estimation.unsettled import chain_recordings
from hil.estimation.unsettled.chain_recordings import _drive
from hil.estimation.unsettled.chain_verdict import chain_verdict
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.errors import ConvergenceError, StandstillError
from tests.support.command_line import hil

SAMPLES = 2000  # of a period of 4000


@pytest.fixture(scope="module")
def setup() -> bench.Setup:
    return bench.set_up(bench.BENCHES[4], 1)


@pytest.fixture(scope="module")
def recorded(setup: bench.Setup, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    period = bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101))
    some = slice(0, SAMPLES)
    table = np.column_stack((np.arange(SAMPLES) / period.rate, period.position.T[some], period.torque.T[some]))
    head = "time,q1,q2,q3,q4,tau1,tau2,tau3,tau4"
    np.savetxt(folder / "arm.csv", table, delimiter=",", header=head, comments="", fmt="%.9g")
    shutil.copyfile(setup.arm.urdf, folder / "arm.urdf")
    return folder


@pytest.fixture(autouse=True)
def _here(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(recorded)
    monkeypatch.setattr(sys, "argv", sys.argv)


def described(setup: bench.Setup, between: str, urdf: str = 'urdf = "arm.urdf"', names: int = 4) -> str:
    joints = "".join(f'[[joints]]\nname = "{name}"\n' for name in setup.arm.joints[:names])
    columns = '[columns]\nposition = ["q1", "q2", "q3", "q4"]\ntorque = ["tau1", "tau2", "tau3", "tau4"]\n'
    text = f'[arm]\n{urdf}\n{joints}{columns}between = "{between}"\n[model]\nfriction = "stribeck"\ndrive = "lag"\n'
    Path("arm.toml").write_text(text, encoding="utf-8")
    return "arm.toml"


def torque_error(setup: bench.Setup, found: api.Estimation) -> float:
    value = np.array([found.parameters[name].value for name in setup.base.names])
    other = bench.path_of(bench.BENCHES[4], setup, 201)
    return bench.errors(setup, value, other)["torque_error_percent"]


def test_commanded_torque_gives_the_likelihood(setup: bench.Setup, capsys: pytest.CaptureFixture[str]) -> None:
    found = api.estimate("arm.csv", config=described(setup, "held"), out="commanded")
    assert torque_error(setup, found) < 0.3
    assert max(found.fit.residual_rms_ticks) < 0.32
    assert found.verdict is not None
    assert found.verdict.trust == "yes"
    assert "mounted" not in " ".join(found.verdict.sentences)
    model = api.load_model("commanded")
    assert model.values["lag"] == pytest.approx(1e-3, abs=1e-4)
    assert hil("export", "commanded", "--format", "urdf", "--out", "found.urdf") == 0
    capsys.readouterr()
    assert hil("estimate", "commanded", "--json") == 0  # again, from what the folder keeps
    again = json.loads(capsys.readouterr().out)
    assert again["parameters"]["viscous_1"]["value"] == pytest.approx(found.parameters["viscous_1"].value)


@pytest.mark.parametrize(("assumed", "base"), [("hanging", "3.1416, 0.0, 0.0"), ("wall", "1.5708, 0.0, 0.0")])
def test_a_wrong_mount_is_named_with_the_base_to_set(setup: bench.Setup, assumed: str, base: str) -> None:
    """The verdict was "no" without a cause."""
    file = Path(described(setup, "held"))
    file.write_text(file.read_text(encoding="utf-8").replace("[arm]", f"[arm]\nbase = [{base}]"), encoding="utf-8")
    verdict = api.estimate("arm.csv", config=str(file), out=assumed).verdict
    assert verdict is not None and verdict.trust == "no"
    said = " ".join(verdict.sentences)
    assert "standing upright, base = [0.0, 0.0, 0.0] under [arm]" in said
    assert "probably because the arm is not mounted as configured" in said and "torque ripple" not in said
    assert verdict.first is not None and verdict.first.startswith("set base = [0.0, 0.0, 0.0]")


@pytest.mark.parametrize(
    ("given", "drive"),
    [("", "delay_lag"), ('[model]\ndrive = "delay"\n', "delay"), ('[model]\nfriction = "stribeck"\n', "delay_lag")],
)
def test_joints_have_lags_of_their_own_unless_the_file_says_otherwise(
    setup: bench.Setup, monkeypatch: pytest.MonkeyPatch, given: str, drive: str
) -> None:
    """One delay for all joints left lags of 1 to 2 ms unexplained, and made torques several times less accurate."""
    file = Path(described(setup, "held"))
    file.write_text(file.read_text(encoding="utf-8").partition("[model]")[0] + given, encoding="utf-8")
    models: list[ChainModel] = []

    def give_up(recordings: object, model: ChainModel, *_: object) -> None:
        models.append(model)
        raise ConvergenceError("far enough")

    monkeypatch.setattr(chain_recordings, "_identified", give_up)
    monkeypatch.setattr(chain_recordings.ColumnCheck, "of", lambda *_: None)
    with pytest.raises(ConvergenceError, match="far enough"):
        api.estimate("arm.csv", config="arm.toml", out="given_up")
    (model,) = models
    assert model.drive == drive
    assert ("lag_ratio_4" in model.names) is (drive != "delay") is ("lags" in model.description)


def fitted(setup: bench.Setup, residual_over_noise: np.ndarray, systematic: float) -> tuple[Any, Any]:
    """An arm's description and the result of a fit that found the prior's values, as far as the verdict needs them."""
    arm = SimpleNamespace(joints=tuple(SimpleNamespace(name=name) for name in setup.arm.joints))
    found = SimpleNamespace(
        **{"model": ChainModel(setup.base), "std": 0.01 * setup.prior.std, "simulated": True, "from_prior": ()},
        **{"residual_over_noise": residual_over_noise, "reached": True, "systematic": systematic},
        names=setup.base.names,
        value=setup.prior.value,
        at_bound=(),
        conflicts=(),
    )
    return arm, found


def test_errors_that_repeat_with_the_motion_are_trusted_with_care(setup: bench.Setup) -> None:
    arm, found = fitted(setup, residual_over_noise=np.ones(4), systematic=0.9)
    well = chain_verdict(found, arm, np.full(4, 0.01), setup.prior)
    assert well.trust == "yes"
    first = setup.arm.joints[0]
    assert well.sentences[0] == f"The largest residual ({first}) is 1.00 times the noise of that joint's angle."
    found.names, found.value = (*found.names, "torque_scale_2"), np.append(found.value, 0.7)
    found.std = np.append(found.std, 1e-3)
    scaled = chain_verdict(found, arm, np.full(4, 0.01), setup.prior)
    assert scaled.trust == "with care" and "disagree by a factor of 1.43" in " ".join(scaled.sentences)
    found.names, found.value, found.std = found.names[:-1], found.value[:-1], found.std[:-1]
    found.systematic = 3.0
    hidden = chain_verdict(found, arm, np.full(4, 0.01), setup.prior)
    assert hidden.trust == "with care"
    assert "repeats with the motion" in hidden.sentences[1]
    found.systematic, found.std = 0.9, 1.1 * setup.prior.std
    assert chain_verdict(found, arm, np.full(4, 0.01), setup.prior).trust == "with care"


@pytest.mark.parametrize(("model", "drive"), [("", "delay_lag"), ('[model]\nfriction = "stribeck"\n', "delay_lag")])
def test_lags_may_differ_by_joint_unless_the_file_gives_the_drive(setup: bench.Setup, model: str, drive: str) -> None:
    """Lags of 1 to 2 ms were fitted by one delay: viscous friction was 4 standard errors off."""
    assert _drive(parse_recording_config(model, Path("arm.toml")), 4) == drive
    assert _drive(parse_recording_config('[model]\ndrive = "delay"\n', Path("arm.toml")), 4) == "delay"
    fitted_model = ChainModel(setup.base, drive="delay_lag", lags=True)
    assert "lag_ratio_4" in fitted_model.names and "lags" in fitted_model.description
    common = ChainModel(setup.base, drive="delay", lags=True)
    assert "lag_ratio_4" not in common.names and "lags" not in common.description
    arm, found = fitted(setup, residual_over_noise=np.ones(4), systematic=3.0)
    found.model = common
    assert "lags that differ by joint" in " ".join(chain_verdict(found, arm, np.full(4, 0.01), setup.prior).sentences)


def test_an_incomplete_model_that_fails_its_own_prediction_is_not_trusted(setup: bench.Setup) -> None:
    arm, found = fitted(setup, residual_over_noise=np.full(4, 8.7), systematic=9.0)
    said = chain_verdict(found, arm, np.full(4, 0.19), setup.prior)
    assert said.trust == "no"
    assert chain_verdict(found, arm, np.full(4, 0.06), setup.prior).trust == "with care"
    useless = chain_verdict(found, arm, np.full(4, 17.8), setup.prior)
    assert "the error is 18 times the torque's own RMS" in " ".join(useless.sentences)


def test_a_reversed_column_is_refused_before_the_fit(setup: bench.Setup) -> None:
    table = np.genfromtxt("arm.csv", delimiter=",", names=True)
    table["tau3"] *= -1.0
    np.savetxt("bad.csv", table, delimiter=",", header=",".join(table.dtype.names or ()), comments="", fmt="%.9g")
    with pytest.raises(CsvError, match=rf"bad.csv: the sign of the torque of {setup.arm.joints[2]} is reversed"):
        api.estimate("bad.csv", config=described(setup, "held"))


def test_exchanged_positions_are_refused_with_the_key_to_set(setup: bench.Setup) -> None:
    table = np.genfromtxt("arm.csv", delimiter=",", names=True)
    table["q2"], table["q3"] = table["q3"].copy(), table["q2"].copy()
    np.savetxt("swapped.csv", table, delimiter=",", header=",".join(table.dtype.names or ()), comments="", fmt="%.9g")
    second, third = setup.arm.joints[1:3]
    said = rf'positions of {second} and {third} .* Set position = \["q1", "q3", "q2", "q4"\] in \[columns\]'
    with pytest.raises(CsvError, match=said):
        api.estimate("swapped.csv", config=described(setup, "held"))


def test_a_zero_that_is_off_is_named_instead_of_effects_that_are_not_there(setup: bench.Setup) -> None:
    """The verdict advised to correct a link's mass, and to look for backlash and loose screws."""
    table = np.genfromtxt("arm.csv", delimiter=",", names=True)
    table["q3"] -= 0.5 * np.pi
    np.savetxt("turned.csv", table, delimiter=",", header=",".join(table.dtype.names or ()), comments="", fmt="%.9g")
    verdict = api.estimate("turned.csv", config=described(setup, "linear"), out="turned").verdict
    assert verdict is not None and verdict.trust == "with care" and verdict.first is not None
    assert verdict.first.startswith("set zero = [0, 0, 1.5708, 0] in [columns]")
    said = " ".join(verdict.sentences)
    assert f"the zero of {setup.arm.joints[2]} seems to be off by 90 degrees" in said
    assert "backlash" not in said and "correct that link's mass" not in said and "torque ripple" not in said


def test_measured_torque_gives_the_regression_and_says_so(setup: bench.Setup) -> None:
    found = api.estimate("arm.csv", config=described(setup, "linear"), out="measured")
    assert "least squares" in found.method
    assert "nothing was simulated" in found.method
    assert found.verdict is not None
    assert found.verdict.trust == "with care"
    assert any('columns.between = "held"' in said for said in found.verdict.sentences)
    assert torque_error(setup, found) < 20.0


@pytest.mark.parametrize(
    ("urdf", "names", "said"),
    [
        ("", 4, "need arm.urdf"),
        ('urdf = "arm.urdf"', 3, r"arm\.toml: 3 .*4 position columns"),
        ('urdf = "absent.urdf"', 4, "absent.urdf"),
    ],
)
def test_what_is_missing_is_named(setup: bench.Setup, urdf: str, names: int, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        api.estimate("arm.csv", config=described(setup, "held", urdf, names), out="refused")
    assert not Path("refused").exists()


def test_the_check_is_made_on_a_part_in_which_every_joint_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    """A joint that rests in the last quarter must not prevent the check."""
    asked: list[float] = []

    def part(recording: Any, start: float, end: float) -> Any:
        if start:
            asked.append(start)
            if start > 0.7:
                raise StandstillError("joint 3 rests")
        return recording

    monkeypatch.setattr(chain_recordings, "_part", part)
    monkeypatch.setattr(chain_recordings, "identify_recordings", lambda *_: None)
    monkeypatch.setattr(chain_recordings, "torque_error", lambda *_: np.full(4, 0.02))
    error, share = chain_recordings._held_out([cast(Any, None)], cast(Any, None), cast(Any, None))
    assert error is not None and share == 0.6 and asked == [0.75, 0.6]


def test_without_a_check_a_large_residual_makes_the_verdict_no(setup: bench.Setup) -> None:
    for residual, trust in ((1.0, "with care"), (4.9, "with care"), (5.1, "no")):
        arm, found = fitted(setup, np.full(4, residual), 0.9)
        assert chain_verdict(found, arm, None, setup.prior).trust == trust
