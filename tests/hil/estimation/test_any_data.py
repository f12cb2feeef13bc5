"""CSV recordings, incomplete runs, peers and calibration with a known mass, on the command line."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil.api.run import load_run
from hil.errors import RunFolderError
from hil.estimator.baselines import compare as peers
from hil.runs.recording import load_samples
from tests.support.command_line import hil
from tests.support.edits import WITHOUT_HELD_OUT
from tests.support.paths import CONFIGS, DATA, ROOT

ArmFile = Callable[..., Path]
RECORDINGS = DATA / "dfki_double_pendulum"
WHOLE = ROOT.parent / "shared" / "data" / "dfki_double_pendulum"
DFKI = CONFIGS / "recordings" / "dfki_double_pendulum.toml"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", sys.argv)


def ratio(result: dict) -> tuple[float, float]:
    """Length of link 1 [m] from coupling and gravity_2, and its standard error."""
    names = result["covariance"]["names"]
    covariance = np.array(result["covariance"]["matrix"])
    coupling, gravity = (result["parameters"][name]["value"] for name in ("coupling", "gravity_2"))
    slope = np.zeros(len(names))
    length = 9.81 * coupling / gravity
    slope[names.index("coupling")], slope[names.index("gravity_2")] = length / coupling, -length / gravity
    return length, float(np.sqrt(slope @ covariance @ slope))


def test_a_real_arm_recorded_by_others(capsys: pytest.CaptureFixture[str]) -> None:
    """Four seconds of a recording suffice to find the length of link 1, 0.2 m, which the file does not contain."""
    text = DFKI.read_text(encoding="utf-8").replace('friction = "stribeck_load"', 'friction = "coulomb"')
    Path("arm.toml").write_text(text.replace("presliding = true", "presliding = false"), encoding="utf-8")
    assert hil("estimate", RECORDINGS / "c1_sinusoids_143339.csv", "--config", "arm.toml", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["joints"] == 2 and result["fit"]["segments"] == 8
    length, std = ratio(result)
    assert length == pytest.approx(0.2, rel=0.2) and abs(length - 0.2) < 3.0 * std
    assert max(result["fit"]["residual_rms_rad"]) < 0.05
    (folder,) = Path("runs").iterdir()
    assert hil("report", folder, "--svg", "pictures") == 0
    assert {"position_1.svg", "torque_2.svg", "correlation.svg"} <= {path.name for path in Path("pictures").iterdir()}
    with pytest.raises(RunFolderError, match=r"hil\.load_model"):
        load_run(folder)


@pytest.mark.slow
@pytest.mark.skipif(not WHOLE.is_dir(), reason="the complete recordings are not available")
def test_the_whole_of_it_is_within_four_percent(capsys: pytest.CaptureFixture[str]) -> None:
    files = sorted(WHOLE.glob("c1_sinusoids_*.csv"))
    assert hil("estimate", *files, "--config", DFKI, "--json") == 0
    length, std = ratio(json.loads(capsys.readouterr().out))
    assert length == pytest.approx(0.2, rel=0.04) and abs(length - 0.2) < 1.96 * std


CSV = "t,q1,q2,i1,i2\n" + "".join(
    f"{0.01 * k:.2f},{np.degrees(np.sin(0.05 * k)):.4f},{np.degrees(np.cos(0.09 * k)):.4f},{np.sin(0.1 * k):.4f},0.1\n"
    for k in range(200)
)
COLUMNS = (
    '[columns]\ntime = "t"\nposition = ["q1", "q2"]\nposition_unit = "deg"\n'
    'current = ["i1", "i2"]\ntorque_constant = [1.8, 1.8]\n'
)


@pytest.mark.parametrize(
    ("csv", "toml", "code", "said"),
    [
        (CSV, COLUMNS.replace('"q2"]', '"elbow"]'), 2, "has no column 'elbow'; it has t, q1, q2, i1, i2"),
        (CSV, COLUMNS.replace("torque_constant = [1.8, 1.8]", ""), 2, "columns.torque_constant is missing"),
        (CSV, COLUMNS.replace('"deg"', '"degrees"'), 2, "position_unit"),
        (CSV, COLUMNS.replace("[1.8, 1.8]", "[1.8]"), 2, "has 1 entry; position has 2"),
        (CSV, COLUMNS.replace('"deg"', '"turns"'), 2, "are these degrees or encoder"),
        (CSV, COLUMNS.replace('time = "t"', 'time = "t"\ntime_unit = "ms"'), 2, "jumps by"),
        (CSV, "[arm]\ngravity = 9.81\n", 2, "columns.torque_constant is missing"),
        (CSV.replace("\n0.50,", "\n0.50,x"), COLUMNS, 2, "column 'q1' is 'x34.2899'; it must be a finite number"),
        (CSV.replace("\n0.50,", "\n0.50,1,"), COLUMNS, 2, "6 fields for 5 columns"),
        (CSV.replace(",0.1\n", ",nan\n"), COLUMNS, 2, "holds no numbers at all"),
        (CSV[:300], COLUMNS, 2, "fields for 5 columns"),
        (CSV, COLUMNS.replace('"q2"]', '"q_2"]'), 2, "Did you mean 'q2'?"),
        (CSV.replace("t,q1", "t [ms],q1"), COLUMNS + 'time_unit = "s"\n', 2, "states the unit ms"),
        (CSV.replace("q1,q2", "q1 [furlong],q2"), COLUMNS.replace('position_unit = "deg"', ""), 2, "'furlong'"),
        (CSV, COLUMNS.replace('"deg"', '"ticks"'), 2, "columns.ticks_per_turn is missing"),
        (CSV, COLUMNS + 'pwm = ["i1", "i2"]\n', 2, "columns.current and columns.pwm are both given"),
        (CSV, COLUMNS.replace("current", "voltage"), 2, "columns.torque_per_volt is missing"),
        (re.sub(r"^(\d\.\d)\d", r"\1", CSV, flags=re.MULTILINE), COLUMNS, 2, "they are too coarse"),
        ("".join(CSV.splitlines(True)[:20]), COLUMNS, 2, "at least 32 are needed"),
        ("", COLUMNS, 2, "is empty"),
    ],
)
def test_a_csv_that_is_wrong_is_named(
    csv: str, toml: str, code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("data.csv").write_text(csv, encoding="utf-8")
    Path("arm.toml").write_text(toml, encoding="utf-8")
    assert hil("estimate", "data.csv", "--config", "arm.toml") == code
    error = capsys.readouterr().err
    assert said in error and "Traceback" not in error


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda columns: columns | {"tau1": np.clip(columns["tau1"], -0.1, 0.1)}, "If the current was clipped"),
        (lambda columns: columns | {"q1": np.where(np.arange(2000) % 10 < 2, np.nan, columns["q1"])}, "20.0 % of its"),
        (lambda columns: columns | {"q1": -np.pi / 2 + (columns["q1"] + np.pi / 2) / 80.0}, "moved by only"),
    ],
)
def test_data_that_is_doubtful_comes_with_a_warning(
    spoil: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert estimate_pendulum(spoil) == 0
    assert said in " ".join(json.loads(capsys.readouterr().out)["warnings"])


def test_degrees_that_are_taken_for_radians_are_refused_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert estimate_pendulum(lambda columns: columns | {"q1": np.degrees(columns["q1"])}) == 2
    assert "Is it in degrees?" in capsys.readouterr().err


def test_torque_of_the_wrong_sign_is_an_error_that_says_where_to_look(capsys: pytest.CaptureFixture[str]) -> None:
    assert estimate_pendulum(lambda columns: columns | {"tau1": -columns["tau1"]}) == 2
    error = capsys.readouterr().err
    assert "the sign of the torque of joint 1 is reversed: as given, inertia_1 would be negative" in error


def estimate_pendulum(spoil: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> int:
    """Estimate a pendulum with 0.02 q'' + 0.5 cos q + 0.03 q' = tau, one of whose columns is spoiled; the exit code."""
    time = 0.0025 * np.arange(2000)
    torque = 0.25 * np.sin(2.0 * time) + 0.2 * np.sin(7.1 * time + 1.0)
    angle, velocity = np.empty(2000), 0.0
    angle[0] = -np.pi / 2
    for k in range(1999):
        velocity += 0.0025 * (torque[k] - 0.5 * np.cos(angle[k]) - 0.03 * velocity) / 0.02
        angle[k + 1] = angle[k] + 0.0025 * velocity
    columns = spoil({"t": time, "q1": angle, "tau1": torque})
    rows = np.column_stack(list(columns.values())).tolist()
    Path("data.csv").write_text(
        "t,q1,tau1\n" + "".join(",".join(map(str, row)) + "\n" for row in rows), encoding="utf-8"
    )
    toml = '[model]\nfriction = "coulomb"\n[columns]\ntime = "t"\nposition = ["q1"]\ntorque = ["tau1"]\n'
    Path("arm.toml").write_text(toml + "position_step = 0.0015\n", encoding="utf-8")
    return hil("estimate", "data.csv", "--config", "arm.toml", "--json")


def test_a_csv_whose_columns_are_unclear_needs_a_config_and_no_run_beside_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Path("data.csv").write_text("a,b,c\n1,2,3\n", encoding="utf-8")
    assert hil("estimate", "data.csv") == 2
    error = capsys.readouterr().err
    assert '--config ARM.toml (in Python: config="ARM.toml")' in error and "a, b, c" in error and "[columns]" in error
    assert not any(Path("runs").glob("*")), "nothing blocks the next attempt"
    assert hil("estimate", "data.csv", "some_run", "--config", "arm.toml") == 2


def test_a_run_cut_short_still_tells_something(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run killed before the second period has no settled one; multiple shooting needs none."""
    identified.rename("run")
    whole = json.loads(Path("run/result.json").read_text(encoding="utf-8"))
    samples = load_samples(Path("run/samples.npy"), 2)
    np.save("run/samples.npy", samples[:2000], allow_pickle=False)
    assert hil("estimate", "run") == 1
    assert capsys.readouterr().err.endswith("Next: hil estimate run --all-samples\n")
    assert hil("estimate", "run", "--all-samples", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["method"].startswith("multiple shooting")
    for name in ("inertia_1", "gravity_1", "gravity_2", "coulomb_1"):
        assert result["parameters"][name]["value"] == pytest.approx(whole["truth"][name], rel=0.03)


def test_compare_and_known_quantities_on_one_run(
    arm_file: ArmFile, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peers, "CUTOFFS", (10.0, 20.0))
    monkeypatch.setattr(peers, "WIDTHS", (0.05,))
    monkeypatch.setattr(peers, "VELOCITY_NOISES", (1e-3,))
    known = "[known]\nmass_1 = 0.18\nmass_2 = 0.2\nmass_elbow = 0.082\n" + (
        "rotor_inertia_1 = 8.0e-8\ngear_ratio_1 = 353.5\n\n[fake]\n"
    )
    assert hil("identify", arm_file(("[fake]\n", known), ("rate = 400.0 ", "rate = 200.0 ")), "--out", "run") == 0
    assert "centre_2" in capsys.readouterr().out
    physical = json.loads(Path("run/result.json").read_text(encoding="utf-8"))["physical"]
    assert physical["quantities"]["centre_2"]["value"] == pytest.approx(0.112, rel=0.005)
    # A small difference of large numbers. Its error bar allows for errors that this model does not include, such as
    # encoder zeros and the ratio of the torque constants.
    inertia = physical["quantities"]["link_inertia_2"]
    assert abs(inertia["value"] - 2.9e-4) < 3.0 * inertia["std"] < 1.3e-4
    assert physical["not_told_apart"] == []
    assert hil("compare", "run", "--json") == 0
    methods = json.loads(capsys.readouterr().out)["methods"]
    assert set(methods) == {"hil", "idim_ls", "rls", "ekf", "ukf", "paper"}
    errors = {name: entry["worst_relative_error"] for name, entry in methods.items()}
    # The Kalman filters' noise levels are chosen by the true parameters: in a single run they may be ahead by chance.
    # benchmarks/peers.py compares all methods over many runs.
    assert 10 * errors["hil"] < min(errors[name] for name in ("idim_ls", "rls", "paper")), "a fair comparison"
    assert max(errors["ekf"], errors["ukf"]) < 0.1
    assert Path("run/compare.json").is_file()


def test_a_known_mass_mends_a_torque_constant(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    """The torque constant in the TOML is 20 % too high for the shoulder and 10 % too low for the elbow."""
    wrong = [("torque_constant = 1.80         #", "torque_constant = 2.16         #")]
    wrong += [("torque_constant = 1.80\ntorque_constant_std", "torque_constant = 1.62\ntorque_constant_std")]
    wrong += WITHOUT_HELD_OUT
    assert hil("record", arm_file(*wrong), "--out", "bare") == 0
    # 0.1 kg at 0.16 m on link 2 (0.2 kg, centre 0.112 m).
    mass, centre = 0.3, (0.2 * 0.112 + 0.1 * 0.16) / 0.3
    inertia = 2.9e-4 + 0.2 * (0.112 - centre) ** 2 + 0.1 * (0.16 - centre) ** 2
    link = f"length = 0.180\nmass = {mass}\ncentre = {centre!r}\ninertia = {inertia!r}"
    bare = "length = 0.180\nmass = 0.200\ncentre = 0.112\ninertia = 2.9e-4"
    assert hil("record", arm_file(*wrong, (bare, link)), "--out", "with_mass") == 0
    capsys.readouterr()
    asked = ("calibrate", "bare", "with_mass", "--mass", "0.1", "--distance", "0.16", "--length", "0.147")
    assert hil(*asked, "--json") == 0
    found = json.loads(capsys.readouterr().out)["torque_per_goal"]
    assert found["shoulder"]["value"] == pytest.approx(1.8, rel=0.01)
    assert found["elbow"]["value"] == pytest.approx(1.8, rel=0.01)
    assert hil(*asked) == 0
    assert "Set torque_constant" in (said := capsys.readouterr().out) and "Do not use" not in said
    assert hil(*asked[:-2]) == 1
    assert "--length" in capsys.readouterr().err
    assert hil("record", arm_file(*wrong, ("seed = 1", "seed = 2")), "--out", "bare_again") == 0
    capsys.readouterr()
    for runs in (("bare", "bare_again"), ("with_mass", "bare")):
        assert hil("calibrate", *runs, *asked[3:]) == 0
        assert "Do not use these values" in (said := capsys.readouterr().out) and "Set torque_constant" not in said
