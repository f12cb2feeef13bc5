"""Servo settings are restored after every kind of ending, including a kill; other servos are left alone."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import serial

from hil.cli.errors import message
from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusShared, DriverError, PortLost, TorqueHeld, TorqueNotOff, WrongModel, WrongSetting
from hil.drivers.joint import Joint
from hil.errors import Cause, ExperimentError, HilError, SafetyStop, StopRequested
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import Fault
from hil.fakes.servo.servo import EmulatedServo
from hil.runs.run_folder import RunFolder
from hil.setup.preflight import Finding, Level, check_arm
from hil.setup.session.end_of_session import about_torque
from hil.setup.session.saved_settings import SavedSettings
from hil.setup.session.servo_session import COUNT_DOWN_S, SETTINGS_NAME, servo_session
from hil.setup.session.settings_file import settings_path
from tests.support.command_line import hil

Arm = Callable[..., Config]
SERVO_2 = 'id = 2\nmodel = "XM430-W350"\nzero_ticks = 2048\n'
FREE = {"Goal Position", "Realtime Tick"}
"""Registers that a servo changes by itself."""


@dataclass
class Bench:
    """One fake arm that keeps its state whenever a port is opened; records EEPROM writes of every servo."""

    port: Any = None
    before: dict[int, dict[str, int]] = field(default_factory=dict)
    eeprom: dict[int, list[str]] = field(default_factory=dict)
    prepare: Callable[[Any], None] = lambda port: None

    @property
    def servos(self) -> dict[int, EmulatedServo]:
        return dict(self.port.bus.servos)

    def changed(self) -> list[str]:
        """Registers that differ from when the port was first opened."""
        return [
            f"{name} of {servo_id}: {value} -> {self.servos[servo_id].value(name)}"
            for servo_id, registers in self.before.items()
            for name, value in registers.items()
            if self.servos[servo_id].value(name) != value
        ]

    def take(self, port: Any) -> None:
        self.port = port
        self.prepare(port)
        for servo_id, servo in port.bus.servos.items():
            table = servo.model.registers.values()
            self.before[servo_id] = {
                each.name: servo.value(each.name) for each in table if each.writable and each.name not in FREE
            }
            self.eeprom[servo_id] = []
            self._count(servo, self.eeprom[servo_id])

    def _count(self, servo: EmulatedServo, written: list[str]) -> None:
        store = servo.memory.store

        def counting(register: Any, value: int) -> None:
            if register.eeprom:
                written.append(register.name)
            store(register, value)

        servo.memory.store = counting  # type: ignore[method-assign]


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    """Every opened port leads to the same arm."""
    made = Bench()
    opened = serial.serial_for_url

    def again(*args: Any, **kwargs: Any) -> Any:
        if made.port is None:
            made.take(opened(*args, **kwargs))
        elif not made.port.is_open:
            made.port.open()
        return made.port

    monkeypatch.setattr(serial, "serial_for_url", again)
    return made


def play(config: Config, folder: Path) -> RunFolder:
    made = RunFolder.create(folder, config)
    run_experiment(config, made, config.path, lambda _: None)
    return made


SHORT = ("ramp = 1.0 ", "held_out = false\nsettle_within = 0.5\nramp = 0.2 ")


def test_a_run_leaves_every_register_as_it_was(arm: Arm, tmp_path: Path, bench: Bench, state_folder: Path) -> None:
    run = play(arm(SHORT), tmp_path / "run")
    assert bench.changed() == []
    assert all(sorted(set(names)) == ["Current Limit", "Operating Mode"] for names in bench.eeprom.values())
    assert all(len(names) <= 4 for names in bench.eeprom.values())
    assert list(state_folder.glob("*.json")) == [], "nothing is left to restore"
    kept = json.loads((run.path / SETTINGS_NAME).read_text())["servos"]
    assert kept["1"]["Operating Mode"] == 3 and kept["1"]["Current Limit"] == 1193


def test_settings_are_on_the_disk_before_the_first_write(arm: Arm, tmp_path: Path, bench: Bench) -> None:
    config = arm(SHORT)
    files = [settings_path(config.url, joint.id, joint.model) for joint in config.joints]
    seen: list[bool] = []
    with servo_session(config):
        seen += [path.is_file() for path in files]
        assert any(bench.eeprom.values())
    assert seen == [True, True] and not any(path.exists() for path in files)


def test_a_return_delay_that_another_program_changed_is_named(arm: Arm, bench: Bench) -> None:
    with pytest.raises(ExperimentError) as stop, servo_session(arm(SHORT)):
        servo = bench.servos[2]
        servo.memory.store(servo.model.registers["Return Delay Time"], 250)
    said = str(stop.value)
    assert "'elbow'" in said and "during this command from 0 to 500 us" in said and "--return-delay-us 0" in said
    assert "'shoulder'" not in said


@pytest.mark.parametrize(("name", "value"), [("Homing Offset", -400), ("Drive Mode", 1)])
def test_a_setting_that_gives_angles_another_meaning_is_named_with_the_value_to_restore(
    arm: Arm, bench: Bench, name: str, value: int
) -> None:
    with pytest.raises(ExperimentError) as stop, servo_session(arm(SHORT)):
        servo = bench.servos[2]
        servo.memory.store(servo.model.registers[name], value)
    said = str(stop.value)
    assert f"{name} was changed during this command from 0 to {value}" in said
    assert "Set it back to 0 with DYNAMIXEL" in said
    assert "'elbow'" in said and "'shoulder'" not in said


def test_torque_that_another_program_switches_on_between_two_runs_is_cut_and_named(arm: Arm, bench: Bench) -> None:
    config = arm(SHORT)
    with pytest.raises(BusShared, match=r"'elbow'.*switched on by another program") as stop, servo_session(config):
        with servo_session(config):
            pass
        bench.servos[2].write(64, b"\1")
        with servo_session(config):
            pytest.fail("the next run began")
    assert not any(servo.torque_enabled for servo in bench.servos.values())
    assert "Torque is off on both servos, confirmed by reading it back." in stop.value.__notes__


def test_a_check_reports_torque_that_came_on_meanwhile_and_leaves_it(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def rate(*_: object) -> Iterator[Finding]:
        bench.servos[2].write(64, b"\1")
        yield Finding(Level.OK, "bus", "rate", "enough")

    monkeypatch.setattr("hil.setup.preflight._rate", rate)
    last = list(check_arm(arm(SHORT)))[-1]
    assert (last.level, last.found) == (Level.STOP, "switched on during this check") and "'elbow'" in last.fix
    assert bench.servos[2].torque_enabled


@pytest.mark.parametrize(("limit", "is_undone"), [(400, True), (60, False)])
def test_a_pwm_limit_that_another_program_lowered_is_named_and_goals_are_restored_up_to_it(
    arm: Arm, bench: Bench, limit: int, is_undone: bool, state_folder: Path
) -> None:
    def lower() -> None:
        servo = bench.servos[2]
        servo.write(36, limit.to_bytes(2, "little"))
        assert servo.value("PWM Limit") == limit

    with (
        pytest.raises(ExperimentError, match=rf"Joint 'elbow'.*PWM Limit was .* 885 to {limit}, .*Goal PWM is {limit}"),
        servo_session(arm(SHORT)),
    ):
        lower()
    assert bench.changed() == [f"PWM Limit of 2: 885 -> {limit}", f"Goal PWM of 2: 885 -> {limit}"]
    assert len(list(state_folder.glob("*.json"))) == 1, "the goal that the limit cuts"
    if is_undone:
        bench.servos[2].write(36, (885).to_bytes(2, "little"))
    with servo_session(arm(SHORT)):
        pass
    assert list(state_folder.glob("*.json")) == [], "the next start tries once more, whether or not it is possible"
    assert bench.servos[2].value("Goal PWM") == (885 if is_undone else limit)


def test_settings_that_a_killed_program_left_are_restored_up_to_a_limit_lowered_since(
    arm: Arm, bench: Bench, state_folder: Path
) -> None:
    config = arm(SHORT)
    joint = config.bus.joints[1]
    with servo_session(config):
        bench.servos[2].write(36, (300).to_bytes(2, "little"))
        kept = settings_path(config.url, joint.id, joint.servo.name)
        left = kept.read_text(encoding="utf-8")
        bench.servos[2].write(36, (885).to_bytes(2, "little"))
    bench.servos[2].write(36, (300).to_bytes(2, "little"))
    kept.write_text(left, encoding="utf-8")
    list(check_arm(config))
    assert not kept.exists() and bench.servos[2].value("Goal PWM") == 300


@pytest.mark.parametrize("kind", ["silent_servo", "reboot", "overheating", "cable_pulled"])
def test_whatever_stops_a_run_its_settings_are_put_back_then_or_at_the_next_start(
    arm: Arm, tmp_path: Path, bench: Bench, kind: str
) -> None:
    config = arm(SHORT)
    bench.prepare = lambda port: port.bus.faults.add(Fault(kind=kind, servo=2, at=2.0))
    with pytest.raises((DriverError, HilError)) as stopped:
        play(config, tmp_path / "run")
    left = bench.changed()
    if left:
        assert any("could not be restored" in note for note in stopped.value.__notes__)
        assert settings_path(config.url, 2, "XM430-W350").is_file()
        bench.port.bus.faults.clear()
        found = list(check_arm(config))
        assert any(each.what == "settings from an earlier run" and each.level is Level.OK for each in found)
    assert bench.changed() == []


def test_an_arm_that_was_stopped_moves_again_only_after_an_announcement(arm: Arm, bench: Bench) -> None:
    config = arm(SHORT)
    said: list[str] = []
    began: list[float] = []
    with servo_session(config, say=said.append):
        for number in range(4):
            before = bench.port.clock.now()
            with suppress(HilError), servo_session(config):
                began.append(bench.port.clock.now() - before)
                if number in (1, 2):
                    raise SafetyStop("It is late.", Cause.LATE)
    assert [seconds >= COUNT_DOWN_S for seconds in began] == [False, False, True, True]
    assert len(said) == 2 and said[0].startswith("THE ARM MOVES AGAIN IN 5 s")


class _Gone(BaseException):
    """Simulates the end of the program."""


@pytest.mark.parametrize("seconds", [0.15, 0.3, 0.5])
def test_a_servo_that_answers_again_after_torque_off_is_off_and_put_back(
    arm: Arm, tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str], seconds: float
) -> None:
    bench.prepare = lambda port: port.bus.faults.add(Fault(kind="silent_servo", servo=2, at=2.0, duration=seconds))
    with pytest.raises(SafetyStop, match="missed") as stop:  # and not TorqueNotOff
        play(arm(SHORT), tmp_path / "run")
    assert [servo.value("Torque Enable") for servo in bench.port.bus.servos.values()] == [0, 0]
    assert bench.changed() == []
    stopped = (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8")
    torque = "\n".join(stop.value.__notes__)
    assert "Torque is off on both servos, confirmed by reading it back." in torque and "rebooted" not in torque
    assert "NOT CONFIRMED" not in torque + capsys.readouterr().err
    if "answers again" in torque:
        assert "Joint 'elbow' (ID 2, XM430-W350) answers again" in stopped.splitlines()[-1]
    assert "missed" in stopped and "replies in a row" in stopped, "the cause, not only that torque was left on"


@pytest.mark.parametrize("servo", [1, 2])
def test_a_servo_that_rebooted_is_named_with_those_that_were_fine(
    arm: Arm, tmp_path: Path, bench: Bench, servo: int
) -> None:
    bench.prepare = lambda port: port.bus.faults.add(Fault(kind="reboot", servo=servo, at=2.0, amount=0.4))
    with pytest.raises(SafetyStop) as stop:  # and not TorqueNotOff, since it is off now
        play(arm(SHORT), tmp_path / "run")
    cause = str(stop.value)
    assert re.search(r"answers again\. Joint .* was rebooted: its Bus Watchdog", "\n".join(stop.value.__notes__))
    if servo == 1:  # it hides the second one
        assert "'elbow' (ID 2, XM430-W350) answered afterwards and joint 'shoulder' (ID 1, XM430-W350) did not" in cause
        assert "adapter" not in cause, "the fault is not in what all servos share"
    assert bench.changed() == []


def drive_again(bench: Bench, after: int, times: int) -> list[int]:
    """Let another program switch torque on at servo 2 once it has been cut and `after` more packets were written.

    It does so again `after` packets after each further cut, `times` in all. Returns a list of the times it did.
    """
    servo, write = bench.servos[2], bench.port.write
    packets, done = [0], [0]

    def watched(data: bytes) -> Any:
        written = write(data)
        packets[0] = 0 if servo.torque_enabled else packets[0] + 1
        if packets[0] > after and done[0] < times:
            done[0] += 1
            for address, value in ((98, b"\x00"), (102, b"\x28\x00"), (100, b"\x28\x00"), (64, b"\x01")):
                servo.write(address, value)
            for address in (102, 100):
                servo.write(address, b"\x28\x00")
        return written

    bench.port.write = watched
    return done


@pytest.mark.parametrize(
    ("after", "stop"),
    [(0, None), (5, None), (40, None), (20, SafetyStop("It swings.", Cause.LATE))],
    ids=["at_once", "early", "late", "stopped"],
)
def test_torque_that_another_program_switches_on_after_it_was_cut_is_cut_again_and_settings_are_restored(
    arm: Arm, bench: Bench, after: int, stop: HilError | None, state_folder: Path
) -> None:
    config = arm(SHORT)
    with pytest.raises(HilError) as ended, servo_session(config), servo_session(config) as bus:
        with bus.torque(config.safety.watchdog):
            pass
        done = drive_again(bench, after, 1)
        if stop is not None:
            raise stop
    assert done == [1] and not any(servo.torque_enabled for servo in bench.servos.values())
    assert bench.changed() == [] and not list(state_folder.glob("*.json"))
    said = "\n".join((str(ended.value), *ended.value.__notes__))
    assert "Another program switched torque on at joint 'elbow' (ID 2, XM430-W350)" in said
    assert "Torque is off on both servos, confirmed by reading it back." in said and "could not be restored" not in said
    assert stop is None or ended.value is stop


@pytest.mark.parametrize("stop", [None, SafetyStop("It swings.", Cause.LATE)], ids=["complete", "stopped"])
def test_torque_that_another_program_keeps_switching_on_is_said_in_capitals(
    arm: Arm, bench: Bench, stop: HilError | None
) -> None:
    config = arm(SHORT)
    with pytest.raises(TorqueNotOff) as ended, servo_session(config), servo_session(config) as bus:
        try:
            with bus.torque(config.safety.watchdog):
                pass
            drive_again(bench, 0, 1_000_000)
            if stop is not None:
                raise stop
        except HilError as error:
            error.add_note(str(bus.torque_off_report))
            raise
    assert bench.servos[2].torque_enabled
    said = message(ended.value)
    assert said.startswith("hil: TORQUE IS ON AT JOINT 'ELBOW' (ID 2, XM430-W350): ANOTHER PROGRAM SWITCHES IT ON")
    assert "CUT THE SUPPLY NOW" in said and "Torque is off on joint 'shoulder' (ID 1" in said
    assert "both servos" not in "\n".join((said, *getattr(stop, "__notes__", ())))
    assert ("It swings." in said) is (stop is not None)


def test_torque_that_another_program_keeps_switching_on_before_a_run_is_not_said_to_be_off(
    arm: Arm, bench: Bench
) -> None:
    stop = ExperimentError("The elbow has turned.")
    with pytest.raises(TorqueNotOff) as ended, servo_session(arm(SHORT)) as bus:
        stop.add_note(about_torque(bus))
        drive_again(bench, 0, 1_000_000)
        raise stop
    said = message(ended.value)
    assert said.startswith("hil: TORQUE IS ON AT JOINT 'ELBOW'") and "The elbow has turned." in said
    assert "Torque is off on all servos" not in said and stop.__notes__ == []


def test_a_killed_run_is_put_back_by_the_next_one_and_by_check(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = arm(SHORT)

    def kill() -> None:
        with pytest.raises(TorqueNotOff), servo_session(config) as bus, bus.torque(0.1):
            write = bench.port.write
            monkeypatch.setattr(bench.port, "write", _raise)  # nothing leaves a killed program
            bench.port.clock.wait_until(bench.port.clock.now() + 1.0)
            raise _Gone
        monkeypatch.setattr(bench.port, "write", write)
        bench.port.close()

    kill()
    assert bench.changed(), "mode and torque are as the killed run left them"
    play(config, tmp_path / "next")
    assert "earlier run" in capsys.readouterr().err
    assert bench.changed() == []
    kill()
    levels = [finding.level for finding in check_arm(config)]
    assert Level.STOP not in levels
    assert bench.changed() == []


def _raise(_: bytes) -> int:
    raise serial.SerialException("no such program")


def test_what_somebody_set_since_a_kill_stays(arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    for servo in bench.servos.values():
        servo.write(11, bytes((4,)))
    list(check_arm(config))
    assert [servo.operating_mode for servo in bench.servos.values()] == [4, 4]


def test_settings_are_not_restored_to_a_servo_of_another_model(arm: Arm, bench: Bench) -> None:
    """The IDs may have been exchanged during the run."""
    said = r"could not be restored\. A servo of a different model now answers at this ID"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        bench.servos[2].memory.set("Model Number", 1060)
        bench.eeprom[2].clear()
    assert bench.eeprom[2] == []


def test_two_servos_of_different_models_that_swapped_their_ids_are_named() -> None:
    tables = [SimpleNamespace(number=number) for number in (1060, 1020)]
    bus: Any = SimpleNamespace(drives={table.number: SimpleNamespace(table=table) for table in tables})
    answers: Any = SimpleNamespace(table=tables[1], title="Joint 'elbow'", read_despite_error=lambda _: 1060)
    with pytest.raises(WrongModel, match=r"Another joint has a servo of that model: their IDs may have been swapped"):
        SavedSettings(bus, print)._check_model(answers)


def test_a_servo_that_swaps_its_id_while_settings_are_restored_is_restored_too(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    """The servo that was restored first then answers for the second one as well, and its settings are right."""
    restore = SavedSettings.put_back

    def swapping(session: SavedSettings, joints: Iterable[Joint]) -> dict[Joint, DriverError]:
        first, second = list(bench.port.bus.servos.values())
        failed = restore(session, list(joints)[:1])
        for servo, other in ((first, 2), (second, 1)):
            servo.memory.set("ID", other)
            servo._derive()
        monkeypatch.setattr(SavedSettings, "put_back", restore)
        return failed | restore(session, list(joints)[1:])

    with servo_session(arm(SHORT)):
        assert bench.changed() != []
        monkeypatch.setattr(SavedSettings, "put_back", swapping)
    assert bench.changed() == []
    assert not list(state_folder.rglob("*.json"))


def test_settings_that_do_not_read_back_as_restored_stay_on_file(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    monkeypatch.setattr(SavedSettings, "put_back", lambda *_: {})
    said = r"ID 1.* and .*ID 2.* could not be restored\. .*they are unverified.* restores them from 2 files"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        pass
    assert len(list(state_folder.rglob("*.json"))) == 2


def test_what_was_put_back_in_part_is_put_back_whole(arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    for servo in bench.servos.values():
        servo.write(11, bytes((3,)))
        servo.write(102, (7).to_bytes(2, "little"))
    list(check_arm(config))
    assert bench.changed() == []


LOWERED = 60
"""A Current Limit that is too low for the arm [ticks]."""


def kill(config: Config, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as gone, pytest.raises(PortLost), servo_session(config) as bus:
        gone.setattr(bench.port, "write", _raise)  # nothing leaves a killed program
        bus.exchange([0.0, 0.0])
    monkeypatch.setattr(bench.port, "write", type(bench.port).write.__get__(bench.port))
    bench.port.close()


def lower(servo: EmulatedServo, limit: int) -> None:
    servo.write(38, limit.to_bytes(2, "little"))
    assert servo.value("Current Limit") == limit


def test_a_current_limit_that_another_program_lowered_before_a_kill_stays_on_file_until_it_is_restored(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    lower(bench.servos[2], LOWERED)
    for number in range(3):
        said: list[str] = []
        with (
            pytest.raises(WrongSetting, match="Current Limit is 60, but") as refused,
            servo_session(config, say=said.append),
        ):
            play(config, tmp_path / str(number))
        assert not hasattr(refused.value, "__notes__"), "nothing is promised"
        assert f"ts Current Limit is {LOWERED} and was 1193 before the run of" in said[-1]
        assert ("this one will" in said[-1]) is (number == 0), "all the rest is restored once"
        assert bench.changed() == [f"Current Limit of 2: 1193 -> {LOWERED}", f"Goal Current of 2: 1193 -> {LOWERED}"]
    (found,) = (each for each in check_arm(config) if each.what == "settings from an earlier run")
    assert found.level is Level.WARNING and "was 1193 before the run of" in found.fix
    lower(bench.servos[2], 1193)
    with servo_session(config):
        pass
    assert bench.changed() == [] and list(state_folder.glob("*.json")) == []


def test_a_current_limit_that_another_program_lowered_and_that_suffices_is_the_servos_own(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path
) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)
    lower(bench.servos[2], 900)
    said: list[str] = []
    with servo_session(config, say=said.append):
        play(config, tmp_path / "next")
    assert "Its Current Limit is 900 and was 1193" in said[-1]
    assert bench.changed() == ["Current Limit of 2: 1193 -> 900", "Goal Current of 2: 1193 -> 900"]
    assert list(state_folder.glob("*.json")) == []


@pytest.mark.parametrize("answers", [True, False])
def test_a_start_that_is_stopped_before_it_reaches_a_servo_restores_it_too_or_says_so(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch, state_folder: Path, answers: bool
) -> None:
    config = arm(SHORT)
    kill(config, bench, monkeypatch)

    def stop(said: str) -> None:
        assert "'shoulder'" in said
        if not answers:
            bench.port.bus.faults.add(Fault(kind="silent_servo", servo=2, at=0.0))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as stopped, servo_session(config, say=stop):
        pass
    waiting = [each.name for each in state_folder.glob("*.json")]
    if answers:
        assert bench.changed() == [] and waiting == []
        return
    assert len(waiting) == 1 and {each.split(" of ")[1][0] for each in bench.changed()} == {"2"}
    (told,) = (note for note in stopped.value.__notes__ if "are not restored yet" in note)
    assert "left on joint 'elbow' (ID 2, XM430-W350)" in told and told.endswith(f"{waiting[0]}.")


def test_a_pilot_writes_each_eeprom_register_twice(tmp_path: Path, bench: Bench) -> None:
    config = load_config(Path("first_time"))
    with servo_session(config):
        for _ in range(3):
            with servo_session(config) as bus, bus.torque(0.1):
                bus.exchange([0.0, 0.0])
    assert bench.changed() == []
    assert all(names.count(name) <= 2 for names in bench.eeprom.values() for name in names)


@pytest.mark.parametrize("mode", [0, 1, 3, 4, 5, 16])
@pytest.mark.parametrize("model", ["XM430-W350", "XL430-W250", "XL330-M288", "XC330-T288"])
def test_a_check_leaves_every_register_as_it_was(arm_file: Any, bench: Bench, model: str, mode: int) -> None:
    path = arm_file()
    head, fake = path.read_text().replace('"XM430-W350"', f'"{model}"').split("\n[fake]\n")
    head = head.replace("current_limit = 1.2", "current_limit = 0.5").replace(
        "current_limit = 0.8", "current_limit = 0.5"
    )
    if model == "XL430-W250":
        head = head.replace("torque_constant", "torque_per_volt").replace("current_limit = 0.5", "voltage_limit = 8.0")
        head = head.replace("= 1.80", "= 0.125").replace("= 0.15", "= 0.01")
    path.write_text(f"{head}\n[fake]\n{fake}")

    def set_up(port: Any) -> None:
        for servo in port.bus.servos.values():
            servo.write(11, bytes((mode,)))
            servo.write(100, (300).to_bytes(2, "little"))  # Goal PWM, and a gain set by the user
            servo.write(84, (777).to_bytes(2, "little"))
            if "Goal Current" in servo.memory:
                servo.write(102, (55).to_bytes(2, "little"))

    bench.prepare = set_up
    found = list(check_arm(load_config(path)))
    assert any(each.what == "rate" and "possible" in each.found for each in found), found
    assert bench.changed() == []
    assert not any(bench.eeprom.values())


def stops(config: Config) -> list[Finding]:
    return [finding for finding in check_arm(config) if finding.level is Level.STOP]


def test_a_check_sees_that_goals_are_dropped(arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def deaf(port: Any) -> None:
        monkeypatch.setattr(port.bus._instructions, "_broadcast", {**port.bus._instructions._broadcast, 0x83: _drop})

    bench.prepare = deaf
    assert {finding.what for finding in stops(arm())} == {"goals"}


def _drop(_body: bytes, _now: float) -> None:
    """Drop a Sync Write."""


@pytest.mark.parametrize(
    ("registers", "what"),
    [
        ('{ "Startup Configuration" = 1 }', "at power-up"),
        ('{ "Drive Mode" = 1 }', "drive mode"),
        ('{ "PWM Limit" = 100 }', "PWM limit"),
    ],
)
def test_settings_with_which_no_run_may_start_are_refused_by_check_and_run(
    arm: Arm, tmp_path: Path, registers: str, what: str
) -> None:
    config = arm((SERVO_2, f"{SERVO_2}registers = {registers}\n"))
    assert what in {finding.what for finding in stops(config)}
    with pytest.raises(WrongSetting):
        play(config, tmp_path / "run")


def test_a_time_based_profile_is_harmless(arm: Arm, tmp_path: Path, bench: Bench) -> None:
    config = arm(SHORT, (SERVO_2, SERVO_2 + 'registers = { "Drive Mode" = 4 }\n'))
    assert stops(config) == []
    play(config, tmp_path / "run")
    assert bench.changed() == []


def test_no_supply_is_a_reason_not_to_start(arm: Arm, bench: Bench) -> None:
    def dead(port: Any) -> None:
        port.bus.servos[2].memory.set("Present Input Voltage", 0)
        port.bus.servos[2].memory.set("Min Voltage Limit", 0)

    bench.prepare = dead
    assert "voltage" in {finding.what for finding in stops(arm())}
    assert arm().safety.min_voltage == 9.5


def hold(port: Any) -> None:
    for servo in port.bus.servos.values():
        servo.write(64, b"\x01")  # in position mode, the fake's initial mode


def test_a_held_arm_is_refused_and_stays_held(arm: Arm, tmp_path: Path, bench: Bench) -> None:
    bench.prepare = hold
    config = arm(SHORT)
    with pytest.raises(TorqueHeld, match="take-over"):
        ServoBus.open(config.bus)
    with pytest.raises(TorqueHeld, match=r"Joint 'shoulder'.*Joint 'elbow'"):
        play(config, tmp_path / "run")
    assert all(servo.torque_enabled for servo in bench.servos.values())
    assert bench.changed() == []


def test_a_held_arm_that_is_taken_over_sinks_slowly(arm: Arm, bench: Bench) -> None:
    fastest: list[float] = []

    def lifted(port: Any) -> None:
        plant = port.bus.plant
        plant.__init__(plant._arm.model_copy(update={"start": (0.0, 0.0)})) if hasattr(plant, "_arm") else None
        hold(port)
        advance = plant.advance

        def watched(until: float, current: Any) -> None:
            advance(until, current)
            fastest.append(max(map(abs, plant.velocity)))

        plant.advance = watched

    bench.prepare = lifted
    config = arm(SHORT)
    taken = config.model_copy(update={"safety": config.safety.model_copy(update={"take_over": True})})
    with servo_session(taken):
        assert not any(servo.torque_enabled for servo in bench.servos.values())
    assert not any(servo.torque_enabled for servo in bench.servos.values())
    assert max(fastest) < 2.0


def test_a_servo_of_somebody_else_keeps_its_torque_and_is_told_of(
    arm_file: Any, tmp_path: Path, bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    def join(port: Any) -> None:
        port.bus.servos[2].write(64, b"\x01")

    bench.prepare = join
    text = arm_file(SHORT).read_text()
    head, fake = text.split("\n[fake]\n")
    port, shoulder, rest = head.split("[[joints]]")
    head = f"{port}[[joints]]{shoulder}[arm]{rest.split('[arm]')[1]}"
    head = head.replace("[-1.5707963, 0.0]", "[-1.5707963]").replace("[0.80, 0.42]", "[0.80]")
    path = tmp_path / "alone.toml"
    path.write_text(f"{head}\n[fake]\n{fake}")
    config = load_config(path)
    play(config, tmp_path / "run")
    assert bench.servos[2].torque_enabled
    assert "ID 2, XM430-W350, torque on" in capsys.readouterr().err
    assert any("ID 2" in finding.found for finding in check_arm(config) if finding.level is Level.WARNING)


def test_a_killed_process_on_a_pty_is_put_back(arm_file: Any, tmp_path: Path) -> None:
    """Two programs, a real SIGKILL between them, and the fake arm in a third process."""
    path = arm_file()
    link = tmp_path / "arm"
    served = subprocess.Popen(
        [sys.executable, "-m", "hil", "fake", str(path), "--pty", "--link", str(link), "--quiet"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert served.stdout is not None and served.stdout.readline()
        real = path.with_name("real.toml")
        real.write_text(path.read_text().split("\n[fake]\n")[0].replace('"fake://"', f'"{link}"'))
        config = load_config(real)
        code = (
            "import os, signal, sys; from pathlib import Path; from hil.config.schema import load_config;"
            "from hil.setup.session.servo_session import servo_session\n"
            "with servo_session(load_config(Path(sys.argv[1]))): os.kill(os.getpid(), signal.SIGKILL)"
        )
        killed = subprocess.run([sys.executable, "-c", code, str(real)], check=False, env=dict(os.environ))
        assert killed.returncode == -9
        with ServoBus.connect(config.bus) as bus:
            assert [bus.servo(joint).read("Operating Mode") for joint in bus.joints] == [0, 0]
        assert hil("check", real) in (0, 1)
        with ServoBus.connect(config.bus) as bus:
            assert [bus.servo(joint).read("Operating Mode") for joint in bus.joints] == [3, 3]
    finally:
        served.terminate()
        served.wait()


@pytest.mark.parametrize(
    "stop", [KeyboardInterrupt(), StopRequested("Stopped by Ctrl-C.")], ids=["interrupt", "signal"]
)
@pytest.mark.parametrize("runs", [0, 1])
def test_a_stop_between_two_runs_says_that_torque_is_off(
    arm: Arm, bench: Bench, stop: BaseException, runs: int
) -> None:
    config = arm(SHORT)
    stop.__notes__ = []
    with pytest.raises(type(stop)) as raised, servo_session(config):
        for _ in range(runs):
            with servo_session(config) as bus, bus.torque(config.safety.watchdog):
                pass
        raise stop
    (note,) = raised.value.__notes__
    assert note.startswith(f"Torque is off on {'both' if runs else 'all'} servos") and "reading it back" in note
    assert ("has not switched it on" in note) is (runs == 0)
