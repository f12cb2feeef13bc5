"""Columns that cannot be what the configuration says are refused, and suggestions use each column once."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hil.config.csv_columns import Columns
from hil.config.recording import parse_recording_config
from hil.errors import ConfigError, CsvError
from hil.estimation.unsettled import recordings as estimates
from hil.estimator.errors import ConvergenceError
from hil.recordings.convert import convert
from hil.recordings.guess import guessed
from hil.recordings.parquet_file import read_dataset
from hil.recordings.table import Table
from hil.recordings.velocity import Rate, contradict, doubts
from hil.results.parts import Verdict

TIME = np.arange(0.0, 10.0, 0.005)
STEP = 2.0 * np.pi / 4096


def table(**columns: Any) -> Table:
    return Table("arm.csv", {"t": TIME, **columns}, {})


def rounded(size: float) -> Any:
    return STEP * np.round(size * np.sin(2.0 * TIME + 0.5 * np.sin(7.0 * TIME)) / STEP)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ('position = ["q1", "q1"]\ntorque = ["a", "b"]', 'arm.toml: columns.position names "q1" twice'),
        (
            'position = ["q1", "q2"]\ncurrent = ["q1", "q2"]\ntorque_constant = [1.0, 1.0]',
            "and columns.current both name",
        ),
        ('time = "q1"\nposition = ["q1"]\ntorque = ["a"]', 'columns.time and columns.position both name "q1"'),
        ('time = "t"\nrate = 100.0\nposition = ["q1"]', "arm.toml: columns.time and columns.rate are both given"),
        ('position = ["q1", "q2"]\ntorque = ["a"]', "arm.toml: columns.torque has 1 entry; position has 2"),
    ],
)
def test_a_column_with_two_roles_is_refused(keys: str, said: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_recording_config(f"[columns]\n{keys}\n", Path("arm.toml"))
    assert said in str(error.value)
    assert "columns: columns" not in str(error.value)


@pytest.mark.parametrize(
    ("names", "lines"),
    [
        ("q1 q2 pos1 pos2 tau1 tau2", ("rate = 200.0", 'position = ["q1", "q2"]', 'torque = ["tau1", "tau2"]')),
        ("t q1 q2 pos1 pos2 i1 i2", ('time = "t"', 'position = ["q1", "q2"]', 'current = ["i1", "i2"]')),
        ("Zeit Winkel1 Winkel2 Moment1 Moment2", ('time = "Zeit"', 'position = ["Winkel1", "Winkel2"]')),
    ],
)
def test_a_suggestion_gives_each_column_its_own_role(names: str, lines: tuple[str, ...]) -> None:
    with pytest.raises(CsvError) as error:
        guessed(Table("arm.csv", dict.fromkeys(names.split(), TIME), {}), Columns())
    for line in lines:
        assert line in str(error.value)


def test_a_joint_that_hardly_moves_is_named() -> None:
    """Too few steps to recognise the encoder's, so that of the other joint is assumed."""
    with pytest.raises(CsvError, match=r"joint 2 moved by 0\.0031 rad"):
        convert(
            table(q1=rounded(1.2), q2=rounded(1.5 * STEP), tau1=rounded(0.5), tau2=rounded(0.1)),
            Columns(time="t", position=["q1", "q2"], torque=["tau1", "tau2"]),
        )


def test_a_torque_column_without_numbers_is_named() -> None:
    with pytest.raises(CsvError, match="torque or current column of joint 2 holds no numbers"):
        convert(
            table(q1=rounded(1.2), q2=rounded(1.0), tau1=rounded(0.5), tau2=np.full(TIME.size, np.nan)),
            Columns(time="t", position=["q1", "q2"], torque=["tau1", "tau2"]),
        )


def test_velocities_that_contradict_positions_make_a_model_useless() -> None:
    twice = [Rate("vel1", 2.0, 0.0), Rate("vel2", 2.0, 0.0)]
    assert contradict(twice) and len(doubts(twice)) == 1
    assert not contradict([Rate("vel1", 1.05, 0.0), Rate("vel2", 1.0, 0.0)])
    read: Any = SimpleNamespace(doubts=("The times are wrong.",), unusable=True)
    assert _trust(read) == "no"
    read.unusable = False
    assert _trust(read) == "with care"


@dataclass(frozen=True)
class Judged:
    verdict: Verdict


def _trust(read: Any) -> str:
    judged: Any = Judged(Verdict("yes", "inertia_1", ()))
    doubted: Any = estimates._doubted(judged, read)
    return str(doubted.verdict.trust)


def test_a_fit_that_fails_names_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ConvergenceError("no friction model could be fitted")

    monkeypatch.setattr(estimates, "_estimate_planar", fail)
    with pytest.raises(ConvergenceError, match=r"arm\.csv: no friction model"):
        estimates.estimate_recordings([Path("arm.csv")], None, None)


@pytest.mark.parametrize("text", ["[]", '{"features": 3}'])
def test_a_dataset_whose_description_is_no_table_is_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(text, encoding="utf-8")
    with pytest.raises(CsvError, match=r"info\.json must hold an object"):
        read_dataset(tmp_path)


@pytest.mark.parametrize(
    ("keys", "unused"),
    [
        (
            {"torque": ["tau1"], "supply_voltage": 12.0, "ticks_per_turn": 4096.0},
            "ticks_per_turn, columns.supply_voltage",
        ),
        ({"torque": ["tau1"], "torque_constant": [1.0], "current_unit": "A"}, "current_unit, columns.torque_constant"),
        ({"current": ["tau1"], "torque_constant": [1.0]}, ""),
        ({"pwm": ["tau1"], "supply_voltage": 12.0, "torque_per_volt": [1.0], "resistance": [5.0]}, "resistance"),
        ({"pwm": ["tau1"], "supply_voltage": 12.0, "torque_constant": [1.0], "resistance": [5.0]}, ""),
    ],
)
def test_keys_without_effect_are_named(keys: dict[str, Any], unused: str) -> None:
    columns = Columns.model_validate({"time": "t", "position": ["q1"], **keys})
    notes = " ".join(convert(table(q1=rounded(1.2), tau1=rounded(0.5)), columns).notes)
    assert (f"arm.csv: columns.{unused} ha" in notes) if unused else ("no effect" not in notes)


@pytest.mark.parametrize(
    ("given", "used"), [(("shoulder",), ("shoulder",)), (("a", "b"), ("joint_1",)), ((), ("joint_1",))]
)
def test_results_name_joints_as_the_configuration_does(given: tuple[str, ...], used: tuple[str, ...]) -> None:
    config = parse_recording_config("".join(f'[[joints]]\nname = "{name}"\n' for name in given), Path("arm.toml"))
    columns = Columns(time="t", position=["q1"], torque=["tau1"])
    read: Any = convert(table(q1=rounded(1.2), tau1=rounded(0.5)), columns)
    assert tuple(joint.name for joint in estimates._arm(read, config).joints) == used


@pytest.mark.parametrize(
    ("lengths", "said"), [("[0]", "must be greater than 0"), ("[0.2, 0.2, 0.2]", "one length per")]
)
def test_link_lengths_are_checked(lengths: str, said: str, tmp_path: Path) -> None:
    rows = zip(TIME, rounded(1.2), rounded(0.5), strict=True)
    text = "t,q1,tau1\n" + "\n".join(",".join(map(str, row)) for row in rows)
    (tmp_path / "arm.csv").write_text(text, encoding="utf-8")
    (tmp_path / "arm.toml").write_text(f"[arm]\nlink_lengths = {lengths}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        estimates.estimate_recordings([tmp_path / "arm.csv"], tmp_path / "arm.toml", None)


@pytest.mark.parametrize("unit", ["mNm", "mN m", "mN*m"])
def test_a_torque_unit_needs_no_space(unit: str) -> None:
    assert Columns.model_validate({"torque_unit": unit}).torque_unit == "mN m"


@pytest.mark.parametrize(
    ("head", "keys", "size", "said"),
    [
        ("tau", {}, 300.0, "would be 300 N m: too much for any servo. Is it in mN m? Then append [mN m]"),
        ("tau", {}, 50.0, ""),
        ("tau [N m]", {}, 300.0, ""),
        ("tau [mN m]", {}, 300.0, ""),
        ("tau", {"torque_unit": "N m"}, 300.0, ""),
        ("current", {"torque_constant": [1.8]}, 700.0, "700, which would be 700 A: too much for any servo. Is it"),
        ("current [mA]", {"torque_constant": [1.8]}, 700.0, ""),
    ],
)
def test_a_torque_or_current_without_a_unit_that_no_servo_has_is_refused(
    head: str, keys: dict[str, Any], size: float, said: str
) -> None:
    read = table(q=rounded(1.0), **{head: size * np.sin(TIME)})
    columns = Columns(time="t", position=["q"], **keys)
    if not said:
        assert convert(read, columns).recordings
        return
    with pytest.raises(CsvError) as error:
        convert(read, columns)
    assert said in str(error.value)


def test_velocities_of_a_simulator_s_log_are_not_suggested_as_torques() -> None:
    log = table(qpos_0=rounded(1.0), qpos_1=rounded(0.5), qvel_0=TIME, qvel_1=TIME, ctrl_0=TIME, ctrl_1=TIME)
    with pytest.raises(CsvError) as error:
        guessed(log, Columns())
    assert 'position = ["qpos_0", "qpos_1"]\ntorque = ["ctrl_0", "ctrl_1"]' in str(error.value)


@pytest.mark.parametrize(
    ("head", "swing", "accepted"), [("q [rad]", 8.0, True), ("q", 8.0, False), ("q [rad]", 200.0, False)]
)
def test_several_turns_are_believed_if_the_column_states_radians_but_no_impossible_speed(
    head: str, swing: float, accepted: bool
) -> None:
    read = table(**{head: rounded(swing), "tau [N m]": np.sin(TIME)})
    columns = Columns(time="t", position=[head], torque=["tau [N m]"])
    if accepted:
        assert convert(read, columns).recordings
        return
    with pytest.raises(CsvError, match="Is it in degrees"):
        convert(read, columns)
