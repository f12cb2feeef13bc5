"""Every cause of a guard stop, provoked on the fake arm: the emulated servos must end without torque."""

import math
import os
import re
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import serial

from hil.cli.errors import exit_code
from hil.config.schema import Config, parse_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusShared, DriverError, TorqueNotOff, WrongModel, WrongSetting
from hil.errors import Cause, DidNotMove, ExperimentError, SafetyStop, StopRequested
from hil.experiment import run
from hil.experiment.checks import work
from hil.experiment.model_watch import UNLIKE_ANY_ARM, ModelWatch
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress, Stream
from hil.fakes.bus.faults import Fault, FaultKind
from hil.plan.plan import Plan, make_plan
from hil.runs.recording import Phase, load_samples, sample_type
from hil.runs.run_folder import RunFolder
from hil.setup.session import servo_session
from tests.support.edits import replaced
from tests.support.paths import CONFIGS
from tests.support.spied_plant import SpiedPlant, Spy, call_at

Arm = Callable[..., Config]
STIFF_GUARD = ("[experiment]\n", "[safety]\nmax_temperature = 40.0\nmin_voltage = 11.0\n\n[experiment]\n")


def swing_elbow(ports: list[Any], velocity: float) -> None:
    """Give the elbow this velocity [rad/s]."""
    plant = ports[0].bus.plant
    plant._state = (*plant._state[:3], velocity, *plant._state[4:])


SHORTER = (
    ("period = 2.0 ", "period = 1.0 "),
    ("band = [0.5, 6.0]", "band = [1.0, 6.0]"),
    ("ramp = 1.0 ", "ramp = 0.5 "),
)
"""Half a run, because its time is proportional to its samples."""


@pytest.fixture
def arm(arm: Arm) -> Arm:
    return lambda *changes, **options: arm(*SHORTER, *changes, **options)


@pytest.fixture(scope="module")
def plan() -> Plan:
    """The plan of every run here, shared because designing it takes longer than playing it."""
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    text = text.replace("period = 10.0 ", "period = 2.0 ").replace("band = [0.1, 5.0]", "band = [0.5, 6.0]")
    text = replaced(text, *SHORTER)
    return make_plan(parse_config(text, CONFIGS)).first_segment()


def run_until_stopped(
    config: Config, folder: Path, act: Callable[[Progress], None], plan: Plan
) -> tuple[SafetyStop, np.ndarray]:
    run = RunFolder.create(folder, config)
    with pytest.raises(SafetyStop) as stop:
        run_experiment(config, run, config.path, act, plan)
    return stop.value, load_samples(run.samples_path, 2)


def once(action: Callable[[], Any], phase: Phase = Phase.PERIODIC, after: int = 500) -> Callable[[Progress], None]:
    done: list[bool] = []

    def act(progress: Progress) -> None:
        if progress.phase == phase and progress.taken >= after and not done:
            done.append(True)
            action()

    return act


def assert_stopped(port: Any) -> None:
    """Assert that both servos have no torque, or a tripped watchdog, and that their motors carry no current."""
    port.clock.wait_until(port.clock.now() + 0.1)
    servos = list(port.bus.servos.values())
    assert len(servos) == 2
    assert all(not servo.torque_enabled or servo.watchdog_tripped for servo in servos)
    assert [servo.motor_current_a for servo in servos] == [0.0, 0.0]


def fault(ports: list[Any], kind: FaultKind, **options: Any) -> None:
    bus = ports[0].bus
    bus.faults.add(Fault(kind=kind, at=bus.time, **options))


def turn_round(ports: list[Any], joint: int) -> None:
    bus = ports[0].bus
    bus.plant = bus._joints._plant = SpiedPlant(bus.plant, Spy(turned=joint))


def stall(ports: list[Any], seconds: float) -> None:
    ports[0].clock._now += seconds


CAUSES: list[tuple[Cause, str, Callable[[list[Any]], None]]] = [
    (Cause.TEMPERATURE, r"'shoulder'.*at 50 degrees C", lambda p: setattr(p[0].bus.servos[1], "temperature_c", 50.0)),
    (
        Cause.VOLTAGE,
        r"'elbow'.*has a supply voltage of 10\.5 V",
        lambda p: setattr(p[0].bus.servos[2], "input_voltage_v", 10.5),
    ),
    (Cause.ALERT, r"'elbow'.*overload", lambda p: fault(p, FaultKind.OVERLOAD, servo=2)),
    (Cause.MISSING, r"'elbow'.*missed 6 replies", lambda p: fault(p, FaultKind.LOST_REPLY, servo=2, duration=0.1)),
    (
        Cause.MISSING,
        r"missed .*\. Replies did arrive, but too late: .*, the USB hub",
        lambda p: fault(p, FaultKind.LATE_REPLY, amount=0.06, duration=0.003),
    ),
    (Cause.LATE, r"deadlines in a row", lambda p: stall(p, 0.06)),
    (
        Cause.JUMP,
        r"'elbow'.*reports an angle that changed by -0",
        lambda p: fault(p, FaultKind.ENCODER_JUMP, servo=2, amount=-120),
    ),
    (
        Cause.TORQUE_OFF,
        r"'shoulder'.*has lost its torque.*Symptom: .*carries 0\.000",
        lambda p: p[0].bus.servos[1].write(64, b"\x00"),
    ),
    (Cause.WRONG_SIGN, r"against its command", lambda p: turn_round(p, 0)),
]


@pytest.mark.parametrize(("cause", "said", "happens"), CAUSES, ids=[cause.name for cause, *_ in CAUSES])
def test_what_goes_wrong_in_a_period_stops_the_arm_for_that_cause(
    arm: Arm,
    tmp_path: Path,
    ports: list[Any],
    plan: Plan,
    cause: Cause,
    said: str,
    happens: Callable[[list[Any]], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if cause in (Cause.TORQUE_OFF, Cause.WRONG_SIGN):
        # Every layer must stop the arm alone; the model detects a disobedient motor too, and may be first.
        monkeypatch.setattr(ModelWatch, "look", lambda *_: None)
    low = () if cause is not Cause.TORQUE_OFF else (("current_limit = 1.2", "current_limit = 0.5"),)
    stop, samples = run_until_stopped(arm(STIFF_GUARD, *low), tmp_path / "run", once(lambda: happens(ports)), plan)
    assert stop.cause is cause and re.search(said, str(stop))
    assert_stopped(ports[0])
    assert (Phase.BRAKING in samples["phase"]) == stop.cause.allows_braking


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
    assert f"{register} from 0 to {value}" in str(stop) and "Symptom: " in str(stop)
    assert stop.overruled
    assert_stopped(ports[0])


@pytest.mark.parametrize(("register", "value"), [("Drive Mode", 1), ("Homing Offset", 40)])
def test_a_setting_that_hardly_shows_in_the_motion_is_read_back(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, register: str, value: int
) -> None:
    def change() -> None:
        ports[0].bus.servos[2].memory.set(register, value)

    config, begun = arm(), once(change)
    with pytest.raises(BusShared, match=rf"'elbow'.* was changed by another program: its {register} reads {value}, "):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, begun, plan)
    assert_stopped(ports[0])


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


@pytest.mark.parametrize(
    ("register", "value"), [("PWM Limit", 700), ("Current Limit", 250), ("Goal PWM", 266), ("Goal PWM", 0)]
)
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
        assert ports[0].bus.servos[2].value(register) == {"Current Limit": 1193, "Goal PWM": 885}[register]
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


@pytest.mark.parametrize(("where", "after"), [(servo_session, "others_on_the_bus"), (run, "_check_pose")])
def test_a_joint_that_turns_before_torque_comes_on_is_refused(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch, where: Any, after: str
) -> None:
    """Its horn slips, or another servo answers: every angle would be off, by less than the rest pose's tolerance."""
    monkeypatch.setattr(where, after, lambda *_: fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=60))
    config = arm()
    made = RunFolder.create(tmp_path / "run", config)
    said = r"'elbow'.* has turned by \+0\.092 rad since .* before torque was"
    with pytest.raises(ExperimentError, match=said) as stop:
        run_experiment(config, made, config.path, lambda _: None, plan)
    assert_stopped(ports[0])
    off = "Torque is off on all servos, confirmed by reading it back; this command has not switched it on."
    assert stop.value.__notes__ == [off]
    assert "None" not in (made.path / "events.jsonl").read_text(encoding="utf-8")


@pytest.mark.parametrize("holds", [False, True], ids=["free", "with a stabiliser"])
def test_an_arm_that_is_elsewhere_once_torque_is_on_has_moved_before_the_start(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch, holds: bool
) -> None:
    """With a stabiliser, the first sample must not differ: from the second one on, the arm is driven."""
    torque = ServoBus._torque_on

    def shift(bus: ServoBus, watchdog: float) -> None:
        torque(bus, watchdog)
        fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=60)

    monkeypatch.setattr(ServoBus, "_torque_on", shift)
    held = (("[experiment]\n", "[stabiliser]\nstiffness = [0.5, 0.2]\ndamping = [0.05, 0.02]\n\n[experiment]\n"),)
    stop, samples = run_until_stopped(arm(*(held if holds else ())), tmp_path / "run", lambda _: None, plan)
    assert stop.cause is Cause.EARLY_MOTION and "'elbow'" in str(stop) and "moved before the start: +0.09" in str(stop)
    assert len(samples) <= 2 and not samples["goal_current"].any()
    assert_stopped(ports[0])


@pytest.mark.parametrize(
    "said", ["Shortly before this, Goal Current of joint 'elbow' was -9 although 3 had been written.", ""]
)
def test_a_foreign_goal_just_before_a_stop_is_noted(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ServoBus, "commanded_by_another", said)
    monkeypatch.setattr(ModelWatch, "look", lambda *_: None)
    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(lambda: swing_elbow(ports, 25.0)), plan)
    assert stop.cause is Cause.VELOCITY
    assert stop.overruled == bool(said) and (said in stop.__notes__) == bool(said)


@pytest.mark.parametrize(
    ("happens", "said"),
    [
        (lambda ports: turn_round(ports, 0), "any arm"),
        (lambda ports: fault(ports, FaultKind.STUCK_JOINT, servo=1), "is not moving|any arm"),
    ],
)
def test_the_model_alone_stops_a_motor_that_does_not_do_as_told(
    arm: Arm,
    tmp_path: Path,
    ports: list[Any],
    plan: Plan,
    monkeypatch: pytest.MonkeyPatch,
    happens: Callable[[list[Any]], None],
    said: str,
) -> None:
    monkeypatch.setattr(work, "TOLERANCE_RAD", math.inf)
    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(lambda: happens(ports)), plan)
    assert stop.cause is Cause.UNEXPECTED and re.search(said, str(stop))
    assert_stopped(ports[0])


def test_a_joint_that_is_elsewhere_than_a_period_before_is_said_so(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short push that the model does not detect; here, the model check is disabled."""
    monkeypatch.setattr(ModelWatch, "look", lambda *_: None)

    def push() -> None:
        swing_elbow(ports, ports[0].bus.plant.velocity[1] + 2.0)

    plan = replace(plan, periods=3)
    run = RunFolder.create(tmp_path / "run", config := arm())
    late = once(push, after=200 + 200 + 4 * 400 + 100)
    with pytest.raises(SafetyStop, match=r"does not repeat its motion: under the same torque") as stop:
        run_experiment(config, run, config.path, late, plan)
    assert stop.value.cause is Cause.UNLIKE_BEFORE
    assert_stopped(ports[0])


def test_a_computer_that_stalls_beyond_the_watchdogs_time_finds_the_arm_stopped(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    tripped: list[bool] = []

    def sleep() -> None:
        stall(ports, 0.3)
        tripped.extend(servo.watchdog_tripped for servo in ports[0].bus.servos.values())

    stop, _ = run_until_stopped(arm(), tmp_path / "run", once(sleep), plan)
    assert tripped == [True, True]
    assert stop.cause is Cause.LATE
    assert_stopped(ports[0])


def test_commands_too_far_apart_for_the_watchdogs(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    config = arm(("rate = 400.0", "rate = 40.0"), ("[experiment]\n", "[safety]\nwatchdog = 0.02\n\n[experiment]\n"))
    stop, samples = run_until_stopped(config, tmp_path / "run", lambda _: None, make_plan(config))
    # Whichever is detected first: the gap, or the servo's own status.
    assert (stop.cause is Cause.LATE and "25 ms passed between two commands" in str(stop)) or (
        stop.cause is Cause.WATCHDOG and "received nothing for 20 ms" in str(stop)
    )
    assert len(samples) <= 2
    assert_stopped(ports[0])


def test_torque_off_is_repeated_until_a_deaf_servo_hears_it(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its watchdog does not act, because another program has switched it off."""
    deaf_s = 0.5
    begun: list[float] = []
    ends: list[float] = []
    repeat = ServoBus.repeat_torque_off

    def deafen() -> None:
        servo = ports[0].bus.servos[2]
        servo.memory.set("Bus Watchdog", 0)
        servo._derive()
        fault(ports, FaultKind.LOST_INSTRUCTION, servo=2, duration=deaf_s)
        begun.append(ports[0].bus.time)

    def note(bus: ServoBus) -> None:
        repeat(bus)
        bus.port.clock.wait_until(bus.port.clock.now() + 1e-3)
        ports[0].bus.advance(bus.port.clock.now())
        if not ports[0].bus.servos[2].torque_enabled and not ends:
            ends.append(bus.port.clock.now() - begun[0])

    monkeypatch.setattr(ServoBus, "repeat_torque_off", note)
    config = arm()
    with pytest.raises(SafetyStop, match="Torque is off on both servos"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, once(deafen), plan)
    assert deaf_s < ends[0] < deaf_s + 0.06


def test_replies_lost_only_while_torque_is_cut_at_the_end_are_named(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut = ServoBus.torque_off

    def behind_a_loss(bus: ServoBus) -> Any:
        fault(ports, FaultKind.LOST_REPLY, servo=2, duration=0.4)
        return cut(bus)

    monkeypatch.setattr(ServoBus, "torque_off", behind_a_loss)
    config = arm()
    with pytest.raises(
        ExperimentError, match=r"^Replies were missing when torque was cut.*\nTorque is off on both servos"
    ):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert_stopped(ports[0])


def test_an_arm_that_moves_before_the_start(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    def push() -> None:
        swing_elbow(ports, 1.5)

    stop, samples = run_until_stopped(arm(), tmp_path / "run", once(push, Phase.REST, 10), plan)
    assert stop.cause is Cause.EARLY_MOTION
    assert set(samples["phase"]) == {Phase.REST} and not samples["goal_current"].any()
    assert_stopped(ports[0])


def test_an_arm_that_is_still_moving_when_the_rest_is_over(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    config = arm()

    def push() -> None:
        swing_elbow(ports, 0.6)

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError, match=r"is moving before the start: joint 'elbow' \(ID 2.* at 0\.\d\d rad/s"):
        run_experiment(config, run, config.path, once(push, Phase.REST, 180), plan)
    assert not load_samples(run.samples_path, 2)["goal_current"][:200].any()
    assert_stopped(ports[0])


FALSE_VELOCITY = (
    r"'elbow' \(ID 2.* reports a velocity of 0\.\d\d rad/s before the start, but its position .* by 0\.000\d rad"
)
MOVES = r"^The arm is moving before the start: joint 'elbow'.* another program is commanding it, or something is push"


@pytest.mark.parametrize(("before_the_end", "said"), [(20, FALSE_VELOCITY), (1, MOVES)])
def test_a_velocity_without_motion_before_the_start_is_a_false_reading_unless_it_has_just_begun(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, before_the_end: int, said: str
) -> None:
    since = plan.rest_samples - before_the_end
    config = arm()

    def freeze() -> None:
        elbow = ports[0].bus.servos[2]
        right = elbow.present.state
        elbow.present.state = lambda position, _velocity, current: right(position, 0.5, current)

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError, match=said):
        run_experiment(config, run, config.path, once(freeze, Phase.REST, since), plan)
    is_braked = Phase.BRAKING in load_samples(run.samples_path, 2)["phase"]
    assert is_braked == (said == MOVES), "no brake may rely on a false velocity"
    assert_stopped(ports[0])


def test_a_goal_that_is_no_number_is_never_sent(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    config = arm()
    broken = plan.segments[0].period_current.copy()
    broken[100, 1] = np.nan
    plan = replace(plan, segments=(replace(plan.segments[0], period_current=broken),))
    stop, samples = run_until_stopped(config, tmp_path / "run", lambda _: None, plan)
    assert stop.cause is Cause.NOT_A_NUMBER
    assert np.isfinite(samples["goal_current"]).all()
    assert_stopped(ports[0])


def test_a_jump_of_the_wanted_current_reaches_the_servos_in_steps(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    config = arm(("[experiment]\n", "[safety]\nslew = 20.0\n\n[experiment]\n"))
    square = np.zeros_like(plan.segments[0].period_current)
    square[::80, 0] = 0.2
    plan = replace(plan, segments=(replace(plan.segments[0], period_current=square),))
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(ExperimentError):  # the elbow, which gets no torque, counts as stuck
        run_experiment(config, run, config.path, lambda _: None, plan)
    sent = load_samples(run.samples_path, 2)["goal_current"]
    assert 0 < np.abs(np.diff(sent, axis=0)).max() <= 20.0 / 400 + 2.7e-3


# Coming to rest


def braked_samples(arm: Arm, folder: Path, ports: list[Any], plan: Plan, then: Callable[[], None] | None) -> int:
    """Number of braking samples after Ctrl-C, with `then` called 12 ms later."""
    config = arm(("[experiment]\n", "[safety]\ndamp_time = 0.06\n\n[experiment]\n"))

    def act() -> None:
        port = ports[-1]
        os.kill(os.getpid(), signal.SIGINT)
        if then is not None:
            call_at(port, port.clock.now() + 0.012, then)

    run = RunFolder.create(folder, config)
    with pytest.raises(StopRequested):
        run_experiment(config, run, config.path, once(act), plan)
    assert_stopped(ports[-1])
    return int(np.count_nonzero(load_samples(run.samples_path, 2)["phase"] == Phase.BRAKING))


def test_braking_takes_its_time_and_no_more(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    assert braked_samples(arm, tmp_path / "run", ports, plan, None) == 24


@pytest.mark.parametrize("second", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_ends_the_braking_at_once(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, second: signal.Signals
) -> None:
    count = braked_samples(arm, tmp_path / "run", ports, plan, lambda: os.kill(os.getpid(), second))
    assert 2 <= count <= 5


def test_a_missed_deadline_ends_the_braking(arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan) -> None:
    assert 2 <= braked_samples(arm, tmp_path / "run", ports, plan, lambda: stall(ports, 0.03)) <= 5


def test_a_cable_unplugged_while_the_arm_is_braked_ends_the_current_within_the_time_of_a_stop(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    """Its watchdogs are shortened: those of the experiment would act 0.12 s or more after the signal."""
    config = arm(("[experiment]\n", "[safety]\ndamp_time = 0.06\n\n[experiment]\n"))
    begun: list[float] = []

    def act() -> None:
        begun.append(ports[-1].clock.now())
        os.kill(os.getpid(), signal.SIGHUP)
        swing_elbow(ports, 8.0)
        call_at(ports[-1], begun[0] + 0.05, lambda: fault(ports, FaultKind.CABLE_PULLED))

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises((StopRequested, TorqueNotOff)):
        run_experiment(config, run, config.path, once(act), plan)
    for servo in ports[-1].bus.servos.values():
        assert 0.03 < servo.heard_at - begun[0] < 0.06, "it was braked until then"
        assert servo.heard_at + servo.watchdog_s - begun[0] < 0.1


def test_a_joint_whose_replies_are_missing_is_not_taken_to_be_at_rest(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    config = arm(("[experiment]\n", "[safety]\nwatchdog = 2.0\nmax_missing = 1000\n\n[experiment]\n"))
    run = RunFolder.create(tmp_path / "run", config)
    lose = once(lambda: fault(ports, FaultKind.LOST_REPLY, servo=2, duration=1.1), Phase.COMING_TO_REST)
    run_experiment(config, run, config.path, lose, plan)
    samples = load_samples(run.samples_path, 2)
    ending = samples[samples["phase"] == Phase.COMING_TO_REST]
    unseen = np.flatnonzero(ending["missing"][:, 1])
    assert len(unseen) > 200
    assert np.isfinite(ending["velocity"][unseen[-1] + 1 :]).all() and len(ending) > unseen[-1] + 1
    assert_stopped(ports[0])


# The servos' own limit


def test_the_servos_own_current_limit_is_lowered_for_the_run_and_restored_after_a_stop(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan
) -> None:
    seen: list[list[int]] = []

    def limits() -> list[int]:
        return [servo.value("Current Limit") for servo in ports[0].bus.servos.values()]

    def look() -> None:
        seen.append(limits())
        fault(ports, FaultKind.ENCODER_JUMP, servo=2, amount=-120)

    run_until_stopped(arm(), tmp_path / "run", once(look), plan)
    assert seen == [[447, 298]], "1.2 and 0.8 A in ticks of 2.69 mA, rounded up"
    assert limits() == [1193, 1193]


# Watchdogs


@pytest.fixture
def as_found(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any], None]], None]:
    """Applies a change to each servo before the port is opened."""

    def prepare(change: Callable[[Any], None]) -> None:
        opened = serial.serial_for_url

        def open_changed(*args: Any, **kwargs: Any) -> Any:
            port = opened(*args, **kwargs)
            for servo in port.bus.servos.values():
                change(servo)
            return port

        monkeypatch.setattr(serial, "serial_for_url", open_changed)

    return prepare


def has_old_firmware(servo: Any) -> None:
    if servo.value("ID") == 2:
        servo.memory.set("Firmware Version", 37)


def was_left_by_a_killed_program(servo: Any) -> None:
    """Leave the servo with torque on, a tripped watchdog and a lowered Current Limit."""
    servo.write(11, b"\x00")  # Operating Mode: current
    servo.write(38, (447).to_bytes(2, "little"))
    servo.write(64, b"\x01")
    servo.trip_watchdog()


Found = Callable[[Callable[[Any], None]], None]


def test_firmware_without_a_bus_watchdog_is_refused(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(has_old_firmware)
    config = arm()
    with pytest.raises(WrongModel, match=r"'elbow' \(ID 2.*firmware 37 has no Bus Watchdog.*allow_no_watchdog = true"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert_stopped(ports[0])
    assert not any(servo.value("Bus Watchdog") for servo in ports[0].bus.servos.values())


def test_firmware_without_a_bus_watchdog_runs_where_the_user_says_so(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(has_old_firmware)
    armed: list[tuple[int, ...]] = []
    config = arm(("[experiment]\n", "[safety]\nallow_no_watchdog = true\n\n[experiment]\n"))

    def look() -> None:
        armed.append(tuple(servo.value("Bus Watchdog") for servo in ports[0].bus.servos.values()))
        os.kill(os.getpid(), signal.SIGINT)

    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(StopRequested):
        run_experiment(config, run, config.path, once(look), plan)
    assert armed == [(4, 0)], "20 ms units: the servo that has a watchdog has it armed, the other is not written to"
    assert_stopped(ports[0])


def test_a_servo_without_a_watchdog_that_falls_silent_is_said_to_go_on(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(has_old_firmware)
    config = arm(("[experiment]\n", "[safety]\nallow_no_watchdog = true\n\n[experiment]\n"))
    pull = once(lambda: setattr(ports[0].bus.servos[2], "connected", False))
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(TorqueNotOff, match=r"NOTHING STOPS JOINT 'ELBOW' \(ID 2.*cut the power now"):
        run_experiment(config, run, config.path, pull, plan)
    port = ports[0]
    port.clock.wait_until(port.clock.now() + 1.0)
    assert not port.bus.servos[1].torque_enabled
    assert port.bus.servos[2].motor_current_a != 0.0, "and it does"


def test_servos_that_a_killed_program_left_behind_are_taken_over(
    arm: Arm, tmp_path: Path, ports: list[Any], plan: Plan, as_found: Found
) -> None:
    as_found(was_left_by_a_killed_program)
    config = arm()
    said = run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None, plan)
    assert said == "Torque is off on both servos, confirmed by reading it back."
    servos = ports[0].bus.servos.values()
    assert not any(servo.torque_enabled or servo.value("Bus Watchdog") for servo in servos)
