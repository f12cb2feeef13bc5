"""Servo settings are restored after every kind of ending, and torque is off or said to be on."""

import json
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hil.cli.errors import message
from hil.config.schema import load_config
from hil.drivers.errors import BusShared, DriverError, PortLost, ServoRefused, TorqueNotOff, WrongModel
from hil.drivers.joint import Joint
from hil.drivers.preparation.prepare import prepare_servo
from hil.drivers.servo import Servo
from hil.errors import Cause, ExperimentError, HilError, SafetyStop, StopRequested
from hil.fakes.bus.faults import Fault
from hil.setup.finding import Finding, Level
from hil.setup.preflight import check_arm
from hil.setup.session import servo_session as servo_session_module
from hil.setup.session.end_of_session import about_torque
from hil.setup.session.saved_settings import SavedSettings
from hil.setup.session.servo_session import COUNT_DOWN_S, ServoSession, servo_session
from hil.setup.session.settings_file import COPY_NAME, settings_path
from tests.support.bench import SHORT, Arm, Bench, play


def test_a_run_leaves_every_register_as_it_was(arm: Arm, tmp_path: Path, bench: Bench, state_folder: Path) -> None:
    run = play(arm(SHORT), tmp_path / "run")
    assert bench.changed() == []
    assert all(sorted(set(names)) == ["Current Limit", "Operating Mode"] for names in bench.eeprom.values())
    assert all(len(names) <= 4 for names in bench.eeprom.values())
    assert list(state_folder.glob("*.json")) == [], "nothing is left to restore"
    kept = json.loads((run.path / COPY_NAME).read_text())["servos"]
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


@pytest.mark.parametrize(
    "after",
    [
        "hil.setup.session.servo_session.settings_now",  # while settings are saved
        "hil.drivers.bus.check_quiet",  # while this program listens for others
        "hil.drivers.bus.prepare_servo",  # the other servo refuses its mode
        "hil.experiment.run._write_facts",  # both refuse their limits
    ],
)
def test_torque_that_another_program_switches_on_during_the_set_up_is_cut_and_named(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, after: str
) -> None:
    module, _, name = after.rpartition(".")
    before = getattr(sys.modules[module], name)
    done: list[object] = []

    def then(*given: Any) -> Any:
        result = before(*given)
        if not done:
            done.append(bench.servos[2].write(64, b"\1"))
        return result

    monkeypatch.setattr(after, then)
    with pytest.raises(BusShared, match=r"'elbow'.*switched on by another program") as stop:
        play(arm(SHORT), tmp_path / "run")
    assert bench.changed() == []
    assert "Torque is off on both servos, confirmed by reading it back." in stop.value.__notes__


def test_a_servo_whose_mode_has_just_been_set_has_no_goal(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change of mode leaves Goal Current at Current Limit: torque that comes on then would drive it with that."""
    goals: list[int] = []

    def prepared(joint: Joint, servo: Servo, others: set[int]) -> None:
        prepare_servo(joint, servo, others)
        goals.append(bench.servos[joint.id].value("Goal Current"))

    monkeypatch.setattr("hil.drivers.bus.prepare_servo", prepared)
    with servo_session(arm(SHORT)):
        assert goals == [0, 0]


@pytest.mark.parametrize("is_run", [False, True])
def test_packets_of_another_master_while_settings_are_restored_are_named(
    arm: Arm, tmp_path: Path, bench: Bench, monkeypatch: pytest.MonkeyPatch, is_run: bool
) -> None:
    def begins(*given: Any) -> Any:
        bench.port.bus.faults.add(Fault(kind="other_master", servo=1, at=bench.port.clock.now()))
        return end(*given)

    end = ServoSession.end
    monkeypatch.setattr(ServoSession, "end", begins)
    with pytest.raises(ExperimentError, match="Another program sent packets on this bus"):
        if is_run:
            play(arm(SHORT), tmp_path / "run")
        else:
            with servo_session(arm(SHORT)):
                pass
    assert bench.changed() == []


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


def test_a_check_keeps_a_goal_until_its_limit_allows_it(arm: Arm, bench: Bench, state_folder: Path) -> None:
    """The message after the run names `hil check` as the next command, before the limit has been set back."""
    with pytest.raises(ExperimentError, match="PWM Limit was changed"), servo_session(arm(SHORT)):
        bench.servos[2].write(36, (400).to_bytes(2, "little"))
    for _ in range(2):
        found = [each for each in check_arm(arm(SHORT)) if each.what == "settings from an earlier run"]
        assert ["Goal PWM is 400 and was 885" in str(each) for each in found] == [True]
        assert len(list(state_folder.glob("*.json"))) == 1
    bench.servos[2].write(36, (885).to_bytes(2, "little"))
    list(check_arm(arm(SHORT)))
    assert bench.servos[2].value("Goal PWM") == 885 and list(state_folder.glob("*.json")) == []


@pytest.mark.parametrize(
    ("address", "goal", "limit", "before"),
    [(36, "Goal PWM", "PWM Limit", 885), (38, "Goal Current", "Current Limit", 1193)],
)
def test_a_goal_that_a_limit_lowered_during_set_up_cuts_is_named(
    arm: Arm,
    bench: Bench,
    monkeypatch: pytest.MonkeyPatch,
    *,
    address: int,
    goal: str,
    limit: str,
    before: int,
) -> None:
    """This program reads the limit only after another program has lowered it."""
    read = servo_session_module.read_settings

    def lowered(servo: Servo) -> dict[str, int]:
        settings = read(servo)
        if servo.id == 2:
            bench.servos[2].write(address, (60).to_bytes(2, "little"))
        return settings | ({limit: 60} if limit in settings and servo.id == 2 else {})

    monkeypatch.setattr(servo_session_module, "read_settings", lowered)
    said = rf"Joint 'elbow'.*: {goal} is 60, not {before} as at the start, because its {limit} is 60\. Another program"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        pass


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


def test_an_adapter_that_was_reset_during_a_run_is_used_again_to_end_it(arm: Arm, tmp_path: Path, bench: Bench) -> None:
    bench.prepare = lambda port: port.bus.faults.add(Fault(kind="cable_pulled", at=2.0, duration=1.0))
    with pytest.raises(PortLost) as lost:  # and not TorqueNotOff
        play(arm(SHORT), tmp_path / "run")
    assert "answers again" in "".join(lost.value.__notes__) and "NOT CONFIRMED" not in "".join(lost.value.__notes__)
    assert not any(servo.torque_enabled for servo in bench.servos.values()) and bench.changed() == []


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


@pytest.mark.parametrize("seconds", [0.07, 0.15])
def test_settings_are_restored_although_an_adapter_holds_back_all_replies_now_and_then(
    arm: Arm, bench: Bench, seconds: float, state_folder: Path
) -> None:
    with servo_session(arm(SHORT)):
        bus = bench.port.bus
        bus.faults.add(Fault(kind="late_reply", at=bus.time, amount=seconds, probability=0.05))
    assert bench.changed() == [] and not list(state_folder.glob("*.json"))


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
        assert "'elbow' (ID 2, XM430-W350) answered and joint 'shoulder' (ID 1, XM430-W350) did not" in cause
        assert "adapter" not in cause, "the fault is not in what all servos share"
    assert bench.changed() == []


def test_a_watchdog_that_another_program_switched_off_is_no_reboot(arm: Arm, tmp_path: Path, bench: Bench) -> None:
    def switch_off(port: Any) -> None:
        port.bus.faults.add(Fault(kind="silent_servo", servo=2, at=2.0, duration=0.3))
        servo, trip = port.bus.servos[2], port.bus.servos[2].trip_watchdog
        servo.trip_watchdog = lambda: (trip(), servo.memory.set("Bus Watchdog", 0))

    bench.prepare = switch_off
    with pytest.raises(SafetyStop) as stop:
        play(arm(SHORT), tmp_path / "run")
    said = "\n".join(stop.value.__notes__)
    assert "another program has switched off its Bus Watchdog" in said and "was rebooted" not in said


def test_a_servo_that_refuses_one_request_in_twenty_is_restored_and_nothing_else_is_said(
    arm: Arm, tmp_path: Path, bench: Bench
) -> None:
    """Without a second attempt, half of all runs ended with settings that were said to be unrestored."""
    config = arm(SHORT)
    with servo_session(config):
        bench.port.bus.faults.add(Fault(kind="status_error", servo=1, at=0.0, amount=4, probability=0.05))
    assert bench.changed() == []


@pytest.mark.parametrize(("times", "is_left"), [(1, False), (10**6, True)])
def test_a_watchdog_that_another_program_sets_after_it_was_restored_is_restored_again_or_named(
    arm: Arm, bench: Bench, times: int, is_left: bool
) -> None:
    def meddle(data: bytes) -> Any:
        written = write(data)
        if restored[0] and left[0] > 0:
            left[0] -= 1
            bench.servos[2].memory.set("Bus Watchdog", 127)
        restored[0] = restored[0] or data[7:10] == b"\x03\x62\x00"
        return written

    restored, left = [False], [times]
    config = arm(SHORT)
    said = pytest.raises(HilError, match=r"'elbow'.*Bus Watchdog .*reads back as 127") if is_left else nullcontext()
    with said, servo_session(config):
        bench.servos[2].memory.set("Bus Watchdog", 50)
        write, bench.port.write = bench.port.write, meddle
    assert bench.changed() == (["Bus Watchdog of 2: 0 -> 127"] if is_left else [])


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
    assert said.startswith("hil: TORQUE IS ON AT JOINT 'ELBOW' (ID 2, XM430-W350): ANOTHER PROGRAM TURNS IT BACK ON")
    assert "CUT THE POWER NOW" in said and "Torque is off on joint 'shoulder' (ID 1" in said
    assert "both servos" not in "\n".join((said, *getattr(stop, "__notes__", ())))
    assert ("It swings." in said) is (stop is not None)


def test_a_program_that_switches_torque_on_now_and_then_does_not_pass_for_one_that_has_stopped(
    arm: Arm, bench: Bench
) -> None:
    """Every 30 ms, so that the reading after a cut finds torque off, whatever follows."""
    config = arm(SHORT)
    with pytest.raises(TorqueNotOff) as ended, servo_session(config), servo_session(config) as bus:
        with bus.torque(config.safety.watchdog):
            pass
        servo, write, next_at = bench.servos[2], bench.port.write, bus.port.clock.now()

        def watched(data: bytes) -> Any:
            nonlocal next_at
            if (now := bus.port.clock.now()) >= next_at:
                next_at = now + 0.03
                servo.write(64, b"\x01")
            return write(data)

        bench.port.write = watched
    assert message(ended.value).startswith("hil: TORQUE IS ON AT JOINT 'ELBOW'")


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


def test_settings_are_not_restored_to_a_servo_of_another_model(arm: Arm, bench: Bench) -> None:
    """The IDs may have been exchanged during the run."""
    said = r"could not be restored\. A servo of a different model now answers at this ID"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        bench.servos[2].memory.set("Model Number", 1060)
        bench.eeprom[2].clear()
    assert bench.eeprom[2] == []


def test_where_one_register_cannot_be_restored_the_message_names_it_and_no_other(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = Servo.write_despite_error

    def refused(servo: Servo, name: str, value: int) -> None:
        if (servo.id, name) == (2, "Operating Mode"):
            raise ServoRefused("It refuses to set its Operating Mode.")
        write(servo, name, value)

    said = r"Some settings of joint 'elbow' \(ID 2.*\) may not have been restored\. .*Only Operating Mode, Goal Current"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        monkeypatch.setattr(Servo, "write_despite_error", refused)
    # The goal that the servo had in position mode would be full torque in current mode.
    assert [each.split(" of ")[0] for each in bench.changed()] == ["Operating Mode", "Goal Current"]


def test_two_servos_of_different_models_that_swapped_their_ids_are_named() -> None:
    tables = [SimpleNamespace(number=number) for number in (1060, 1020)]
    bus: Any = SimpleNamespace(drives={table.number: SimpleNamespace(table=table) for table in tables})
    answers: Any = SimpleNamespace(table=tables[1], title="Joint 'elbow'")
    answers.read_despite_error = answers.read_surely = lambda _: 1060
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
    said = r"ID 1.* and .*ID 2.* could not be restored\. .*another program writes to it.* restores them from 2 files"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        pass
    assert len(list(state_folder.rglob("*.json"))) == 2


def test_a_goal_that_another_program_keeps_writing_is_named_with_its_value(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    restore = SavedSettings.put_back

    def put_back(session: SavedSettings, joints: Iterable[Joint]) -> dict[Joint, DriverError]:
        failed = restore(session, list(joints))
        servo = bench.servos[2]
        servo.memory.store(servo.model.registers["Goal Current"], -36)
        return failed

    monkeypatch.setattr(SavedSettings, "put_back", put_back)
    said = r"'elbow'.*Goal Current reads -36 after 1193 was restored .*another program writes to it.* Stop that program"
    with pytest.raises(ExperimentError, match=said), servo_session(arm(SHORT)):
        pass


def test_a_pilot_writes_each_eeprom_register_twice(tmp_path: Path, bench: Bench) -> None:
    config = load_config(Path("first_time"))
    with servo_session(config):
        for _ in range(3):
            with servo_session(config) as bus, bus.torque(0.1):
                bus.exchange([0.0, 0.0])
    assert bench.changed() == []
    assert all(names.count(name) <= 2 for names in bench.eeprom.values() for name in names)


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


def test_another_master_before_torque_was_switched_on_leaves_a_word_about_torque(arm: Arm, bench: Bench) -> None:
    with pytest.raises(BusShared) as stop, servo_session(arm(SHORT)):
        raise BusShared("Another master")
    assert any("this command has not switched it on" in note for note in stop.value.__notes__)
