"""Settings that another program changes during a run: they are named as the cause, and restored."""

import re
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from hil.cli.errors import exit_code
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusShared, DriverError, WrongSetting
from hil.errors import Cause, DidNotMove, ExperimentError, SafetyStop
from hil.experiment import run
from hil.experiment.model_watch import UNLIKE_ANY_ARM
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress, Stream
from hil.fakes.bus.faults import FaultKind
from hil.plan.plan import Plan, make_plan
from hil.runs.recording import Phase, sample_type
from hil.runs.run_folder import RunFolder
from hil.setup.session import servo_session
from tests.support.stops.stopped_runs import Arm, assert_stopped, fault, once, run_until_stopped, swing_elbow


def rewritten(ports: list[Any], register: str, value: int) -> None:
    """Another program switches a servo's torque off, writes to its EEPROM, and switches torque on again."""
    servo = ports[0].bus.servos[2]
    servo.write(64, b"\x00")
    entry = servo.model.registers[register]
    servo.write(entry.address, value.to_bytes(entry.size, "little", signed=True))
    servo.write(64, b"\x01")


@pytest.mark.parametrize(("register", "value"), [("Drive Mode", 1), ("Homing Offset", 300)])
def test_settings_that_another_program_changed_are_the_cause_that_is_named(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, register: str, value: int
) -> None:
    happens = once(lambda: rewritten(ports, register, value))
    stop, _ = run_until_stopped(arm(), tmp_path / "run", happens, plan)
    assert str(stop).startswith("Another program changed the settings of a servo during the run (joint 'elbow'")
    assert f"{register} from 0 to {value}" in str(stop)
    symptom = str(stop).partition("Symptom: ")[2]
    assert symptom and ". " not in symptom, "what happened, without other causes"
    assert stop.overruled
    assert_stopped(ports[0])


@pytest.mark.parametrize(
    ("register", "value"), [("Drive Mode", 1), ("Homing Offset", 40), ("Goal PWM", 266), ("Goal PWM", 0)]
)
def test_a_setting_that_hardly_shows_in_the_motion_is_read_back(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, register: str, value: int
) -> None:
    def change() -> None:
        ports[0].bus.servos[2].memory.set(register, value)

    config, begun = arm(), once(change)
    with pytest.raises(BusShared, match=rf"'elbow'.* was changed by another program: its {register} reads {value}, "):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, begun, plan)
    assert_stopped(ports[0])
    assert ports[0].bus.servos[2].value("Goal PWM") == 885


@pytest.mark.parametrize(("register", "value"), [("PWM Limit", 5), ("Current Limit", 20)])
def test_a_limit_that_another_program_lowered_is_the_cause_that_is_named(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, register: str, value: int
) -> None:
    def lower() -> None:
        rewritten(ports, register, value)
        if register == "PWM Limit":  # this arm's supply is ideal, so that a lower PWM Limit alone changes nothing
            fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=-120)

    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(lower), plan)
    assert str(stop).startswith("Another program changed the settings of a servo during the run (joint 'elbow'")
    assert re.search(rf"{register} from \d+ to {value}\b", str(stop)) and stop.overruled
    changed = f"PWM Limit was changed during this command from 885 to {value}"
    unrestored = [line for line in stop.__notes__ if changed in line]
    assert len(unrestored) == (register == "PWM Limit")
    assert not any("next hil identify" in line for line in stop.__notes__), "a promise that could not be kept"
    assert_stopped(ports[0])


@pytest.mark.parametrize(("register", "value"), [("PWM Limit", 700), ("Current Limit", 250)])
def test_a_lowered_limit_that_stops_nothing_is_named_at_the_end_of_the_run(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, register: str, value: int
) -> None:
    def lower(progress: Progress) -> None:
        if progress.phase == Phase.COMING_TO_REST:
            servo = ports[0].bus.servos[2]
            servo.memory.set(register, value)

    config = arm()
    run = RunFolder.create(tmp_path / "run", config)
    if register != "PWM Limit":
        said = run_experiment(config, run, config.path, lower, plan)
        assert ports[0].bus.servos[2].value(register) == 1193
    else:
        with pytest.raises(ExperimentError, match="PWM Limit was changed during this command from 885 to 700") as stop:
            run_experiment(config, run, config.path, lower, plan)
        said = str(stop.value)
    assert "'elbow'" in said and str(value) in said
    assert re.search(rf"{register} from \d+ to {value}\b", (run.path / "events.jsonl").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("seconds", "cause", "text", "is_doubted"),
    [
        (1.0, Cause.POSITION, "is at 3 rad.", True),
        (5.0, Cause.POSITION, "is at 3 rad.", False),
        (1.0, Cause.UNEXPECTED, f"It {UNLIKE_ANY_ARM}.", True),
        (1.0, Cause.UNEXPECTED, "It jerked.", False),
        (1.0, Cause.VELOCITY, "is fast.", False),
    ],
)
def test_mistakes_in_the_description_are_named_only_at_the_beginning(
    seconds: float, cause: Cause, text: str, is_doubted: bool
) -> None:
    samples = np.zeros(1000, sample_type(2))
    samples["time_before_write"] = np.linspace(0.0, 20.0 + seconds, 1000)
    samples["goal_current"][samples["time_before_write"] > 20.0] = 0.1
    run.doubt_description(stop := SafetyStop(text, cause), samples)
    assert ("direction, id, torque_constant and wiring" in str(stop)) == is_doubted


@pytest.mark.parametrize("stopped", [False, True])
def test_a_protection_that_another_program_switched_off_is_named_and_restored(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, stopped: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def cycle() -> None:
        ports[0].bus.servos[2].memory.set("Shutdown", 0)
        ports[0].bus.servos[1].memory.set("Temperature Limit", 100)
        for name, value in changed.items():
            ports[0].bus.servos[1].memory.set(name, value)
        if stopped:
            swing_elbow(ports, 25.0)

    changed = {"Status Return Level": 1, "Velocity Limit": 10, "Max Position Limit": 3000, "Secondary(Shadow) ID": 7}
    config, folder = arm(), tmp_path / "run"
    if stopped:
        changed.pop("Secondary(Shadow) ID")
        stop, _ = run_until_stopped(config, folder, once(cycle), plan)
        said = " ".join(stop.__notes__)
        assert stop.cause is Cause.VELOCITY and "Shutdown" not in str(stop)
    else:
        said = run_experiment(config, RunFolder.create(folder, config), config.path, once(cycle), plan)
    assert "Another program changed" in said and "Shutdown from 52 to 0" in said
    assert "Temperature Limit from 80 to 100" in said
    before = {"Status Return Level": 2, "Velocity Limit": 200, "Max Position Limit": 4095, "Secondary(Shadow) ID": 255}
    assert all(f"{name} from {before[name]} to {value}" in said for name, value in changed.items())
    assert {name: ports[0].bus.servos[1].value(name) for name in before} == before
    assert ports[0].bus.servos[2].value("Shutdown") == 52
    assert ports[0].bus.servos[1].value("Temperature Limit") == 80
    restored = capsys.readouterr().err
    assert "joint 'elbow' (ID 2, XM430-W350): Shutdown was 0 and is 52 again" in restored
    assert "Temperature Limit was 100 and is 80 again" in restored and "Current Limit" not in restored


def test_a_servo_that_was_told_to_answer_pings_only_is_named_and_confirmed_off(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    mute = once(lambda: ports[0].bus.servos[1].write(68, b"\0"))
    stop, _ = run_until_stopped(arm(), tmp_path / "run", mute, plan)
    assert stop.cause is Cause.MISSING and "Status Return Level from 2 to 0). Symptom:" in str(stop)
    assert "Torque is off on both servos" in " ".join(stop.__notes__)
    assert ports[0].bus.servos[1].value("Status Return Level") == 2


@pytest.mark.parametrize("boots_in", [0.05, 0.2, 0.217, 0.224, 0.231, 0.25])
def test_a_servo_that_boots_while_torque_is_cut_is_not_said_to_have_other_settings(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, boots_in: float
) -> None:
    """It does not answer the read, but then it answers the ping."""
    reboots = once(lambda: fault(ports, FaultKind.REBOOT, servo=1, amount=boots_in))
    stop, _ = run_until_stopped(arm(), tmp_path / "run", reboots, plan)
    said = " ".join([str(stop), *stop.__notes__])
    assert "Status Return Level" not in said and "was rebooted" in said
    assert_stopped(ports[0])


@pytest.mark.parametrize("ago", [0.02, 0.2])
def test_a_mode_that_may_have_changed_after_a_stop_at_a_limit_is_not_said_to_be_its_cause(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch, ago: float
) -> None:
    def change(bus: ServoBus, _before: Any = None) -> Any:
        found.append(settings_now(bus))
        if len(found) == 2:  # once torque is off
            ports[0].bus.servos[1].memory.set("Operating Mode", 3)
            return settings_now(bus)
        return found[0]

    found: list[Any] = []
    settings_now = run.settings_now
    monkeypatch.setattr(run, "settings_now", change)
    if ago > 0.1:
        monkeypatch.setattr(ServoBus, "modes_seen_ago", ago)
    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(lambda: swing_elbow(ports, 40.0)), plan)
    changed = "Another program changed the settings of a servo during the run (joint 'shoulder'"
    assert stop.cause is Cause.VELOCITY and changed in str(stop)
    if ago > 0.1:
        assert str(stop).startswith(changed) and "Symptom: Joint 'elbow'" in str(stop)
    else:
        assert str(stop).startswith("Joint 'elbow'") and "Symptom" not in str(stop)
        assert re.search(r"magnet.* changed .* may have happened after the stop: \d+ ms before the stop", str(stop))


def test_a_return_delay_that_another_program_raised_is_named_before_late_replies(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    def slow_down() -> None:
        for servo in ports[0].bus.servos.values():
            servo.memory.set("Return Delay Time", 254)
            servo._derive()

    config = arm(("rate = 400.0", "rate = 800.0"))
    stop, _ = run_until_stopped(config, tmp_path / "run", once(slow_down), make_plan(config).first_segment())
    assert re.match(r"Another program changed .*'elbow'.*Return Delay Time from 0 us to 508 us\)\. Sym", str(stop))
    assert "Operating Mode" not in str(stop) and stop.cause in (Cause.LATE, Cause.MISSING)
    assert_stopped(ports[0])


@pytest.mark.parametrize(
    "symptom",
    [None, DidNotMove("Joint 'elbow' did not move: it is stuck."), SafetyStop("It jams: x", Cause.UNEXPECTED)],
)
def test_torque_that_was_lost_before_this_program_cuts_it_is_named(
    arm: Arm, tmp_path: Path, ports: list[Any], symptom: ExperimentError | None
) -> None:
    """Neither at the end of a run nor at a stop whose cause it may be is lost torque covered by torque off."""

    def play(stream: Stream) -> None:
        stream._sample([0.0, 0.0], Phase.REST, -1)
        ports[0].bus.servos[2].write(64, b"\0")
        if symptom is not None:
            raise symptom

    config = arm()
    folder = RunFolder.create(tmp_path / "run", config)
    with mock.patch.object(Stream, "_play_all", play), pytest.raises(SafetyStop, match="has lost its torque") as stop:
        run_experiment(config, folder, config.path, lambda _: None)
    assert stop.value.cause is Cause.TORQUE_OFF and "'elbow'" in str(stop.value)
    told = "" if symptom is None else f" Symptom: {str(symptom).partition(':')[0]}."
    assert str(stop.value).endswith(f"is using this bus.{told}")


def test_settings_changed_before_torque_comes_on_are_refused(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shift(*_: object) -> None:
        ports[0].bus.servos[2].memory.set("Homing Offset", 30)  # 0.05 rad, within the tolerance of the rest pose

    monkeypatch.setattr(run, "_write_facts", shift)
    config = arm()
    with pytest.raises(BusShared, match=r"'elbow'.*Homing Offset from 0 to 30\)\. Torque has not been switched"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert_stopped(ports[0])


def test_an_offset_changed_before_the_pose_is_checked_is_named_not_its_effect(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "_check_rate", lambda *_: ports[0].bus.servos[2].memory.set("Homing Offset", 60))
    config = arm()
    with pytest.raises(BusShared, match=r"'elbow'.*Homing Offset from 0 to 60\)\. Torque has not been switched"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert_stopped(ports[0])


@pytest.mark.parametrize(
    ("register", "value", "kind", "said"),
    [
        (
            "Status Return Level",
            1,
            BusShared,
            "Status Return Level from 2 to 1). Torque has not been switched on",
        ),
        ("Drive Mode", 8, WrongSetting, "Drive Mode is 8"),
    ],
)
@pytest.mark.parametrize("runs", [0, 1])
def test_what_is_found_on_the_bus_after_a_run_is_no_wrong_input(
    arm: Arm,
    tmp_path: Path,
    ports: list[Any],
    plan: Plan,
    register: str,
    value: int,
    kind: type[DriverError],
    said: str,
    runs: int,
) -> None:
    """runs: number of runs of the same command before another program changes a servo."""
    config = arm()

    def play(number: int) -> None:
        run_experiment(config, RunFolder.create(tmp_path / f"{number}", config), config.path, lambda _: None, plan)

    with pytest.raises(kind) as stop, servo_session.servo_session(config):
        for number in range(runs):
            play(number)
        ports[0].bus.servos[2].memory.set(register, value)
        play(runs)
    assert said in str(stop.value)
    assert ("on again after the previous run" in str(stop.value)) == (kind is BusShared and runs > 0)
    assert ("has not switched it on" in "".join(stop.value.__notes__)) == (runs == 0)
    assert exit_code(stop.value) == (2 if kind is WrongSetting and runs == 0 else 1)
