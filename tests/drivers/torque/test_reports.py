"""Torque that another program holds on, servos confirmed later, and faults, as a bus reports and handles them."""

from collections.abc import Callable

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import DriverError, NoReply, ServoFault, ServoRefused, TorqueNotOff
from hil.drivers.packet import HardwareError, StatusError
from hil.drivers.servo import Servo
from tests.support.bench import servos

Make = Callable[..., BusConfig]
TORQUE, OPERATING_MODE, POSITION_MODE = 64, 11, 3


def left_silent(bus: ServoBus, servo_id: int) -> None:
    """Cut torque while this servo does not answer; afterwards it answers again."""
    silent = servos(bus)[servo_id]
    with pytest.raises(TorqueNotOff), bus.torque(watchdog=0.1):
        bus.exchange([0.0, 0.0])
        silent.connected = False
    silent.connected = True


def test_a_servo_that_answers_again_is_confirmed_once(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        first, second = bus.drives
        assert not bus.confirm_later(second), "torque was never cut"
        left_silent(bus, 2)
        assert servos(bus)[2].torque_enabled and bus.is_watched
        assert bus.torque_now() == {first: False}, "the silent one is not asked"
        assert not bus.confirm_later(first)
        assert bus.confirm_later(second)
        assert not servos(bus)[2].torque_enabled and servos(bus)[2].value("Bus Watchdog") == 0
        assert not bus.is_watched
        assert bus.torque_now() == {first: False, second: False}
        report = bus.torque_off_report
        assert report is not None and report.is_off and report.later == {second}
        assert not report.rebooted and not report.disarmed, "its watchdog stopped it"
        assert not bus.confirm_later(second)


def test_a_servo_that_stays_silent_remains_unconfirmed(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        second = tuple(bus.drives)[1]
        left_silent(bus, 2)
        servos(bus)[2].connected = False
        with pytest.raises(NoReply):
            bus.confirm_later(second)
        assert bus.torque_off_report is not None
        assert [joint for joint, _ in bus.torque_off_report.unconfirmed] == [second]


def test_torque_off_is_repeated_for_a_servo_that_can_only_hear(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        left_silent(bus, 2)
        bus.repeat_torque_off()
        bus.read_positions()  # lets the bus deliver what was sent
        assert not servos(bus)[2].torque_enabled


def test_torque_that_another_program_switches_on_is_read_and_cut(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        first, second = bus.drives
        with bus.torque(watchdog=0.1):
            assert bus.has_torque()
        assert not bus.has_torque()
        servos(bus)[2].write(TORQUE, b"\1")
        assert not bus.has_torque() and bus.torque_now() == {first: False, second: True}
        bus.cut_foreign_torque([second])
        assert bus.torque_now() == {first: False, second: False}


def test_goals_of_servos_that_another_program_drives_are_zeroed_in_this_program_s_mode_only(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        first, second = bus.drives
        with bus.torque(watchdog=0.1):
            bus.exchange([0.3, 0.3])
        servos(bus)[2].write(OPERATING_MODE, bytes((POSITION_MODE,)))
        for each in servos(bus).values():
            each.memory.set("Goal Current", 50)
        bus.zero_own_goals([first, second])
        assert [each.value("Goal Current") for each in servos(bus).values()] == [0, 50]


def test_what_a_session_finds_after_torque_was_cut_is_added_to_the_report(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        first, second = bus.drives
        bus.report_doubted(second, "It holds its joint.")
        report = bus.torque_off_report
        assert report is not None and report.confirmed == (first,)
        bus.report_driven([first], [])
        driven = bus.torque_off_report
        assert driven is not None and driven.driven == (first,)
        assert driven.unconfirmed == ((second, "It holds its joint."),), "what was known before is kept"
    with ServoBus.open(fake_config()) as bus:
        first, second = bus.drives
        bus.report_driven([first], [])
        assert bus.torque_off_report is not None and bus.torque_off_report.confirmed == (second,)


def test_whether_this_program_has_switched_torque_on_and_armed_watchdogs(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        assert not bus.has_switched_on and not bus.is_watched
        with bus.torque(watchdog=0.1):
            assert bus.has_switched_on and bus.is_watched and bus.armed_ticks == 5
        assert bus.has_switched_on and not bus.is_watched


def test_a_servo_that_refuses_torque_because_of_a_fault_is_named_with_it(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        servos(bus)[2].fail(HardwareError.OVERLOAD)
        with pytest.raises(ServoFault, match=r"'elbow'.*overload.*stays off until it is rebooted"), bus.torque(0.1):
            pytest.fail("torque came on")
        assert not any(each.torque_enabled for each in servos(bus).values())


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ([HardwareError.INPUT_VOLTAGE] * 2, "hardware error: input voltage"),
        ([HardwareError.OVERLOAD, HardwareError(0)], "raised its alert, but reports no hardware error now"),
        ([HardwareError(0)], "refused writing 1 to Torque Enable"),
    ],
)
def test_a_servo_that_refuses_torque_is_named_with_its_hardware_error_if_there_is_one(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch, errors: list[HardwareError], said: str
) -> None:
    with ServoBus.open(fake_config()) as bus:
        servo, shown = list(bus.drives.values())[1], iter(errors)
        write = servo.write

        def refusing(register: str, value: int) -> None:
            if (register, value) == ("Torque Enable", 1):
                raise ServoRefused(f"{servo.title} refused writing 1 to Torque Enable.", StatusError.ACCESS)
            write(register, value)

        monkeypatch.setattr(servo, "write", refusing)
        monkeypatch.setattr(servo, "hardware_error", lambda: next(shown))
        with pytest.raises(DriverError, match=said) as stop, bus.torque(0.1):
            pytest.fail("torque came on")
        assert isinstance(stop.value, ServoFault) is bool(errors[0]) and "'elbow'" in str(stop.value)


def test_a_faulty_servo_whose_shutdown_setting_cannot_be_read_counts_as_without_torque(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:
        second = tuple(bus.drives)[1]
        servos(bus)[2].memory.set("Hardware Error Status", int(HardwareError.INPUT_VOLTAGE))
        read = bus.drives[second].read

        def reading(register: str) -> int:
            if register == "Shutdown":
                raise NoReply("silent")
            return read(register)

        monkeypatch.setattr(bus.drives[second], "read", reading)
        assert "Its torque stays off until it is rebooted" in bus._fault(second, its_own=True)


@pytest.mark.parametrize(
    ("answer", "rebooted", "disarmed"), [(True, {2}, set()), (False, set(), {2}), (None, *2 * [set()])]
)
def test_a_watched_servo_that_was_silent_when_torque_was_cut_is_asked_whether_it_was_rebooted(
    fake_config: Make,
    monkeypatch: pytest.MonkeyPatch,
    answer: bool | None,
    rebooted: set[int],
    disarmed: set[int],
) -> None:
    asked: list[int] = []

    def was_rebooted(servo: Servo) -> bool | None:
        asked.append(servo.id)
        return answer

    monkeypatch.setattr("hil.drivers.torque.switch.was_rebooted", was_rebooted)
    with ServoBus.open(fake_config()) as bus:
        with bus.torque(watchdog=0.1):
            bus.exchange([0.0, 0.0])
        assert asked == [], "all have answered"
        for is_watched in (True, False):
            if not is_watched:
                bus._without_watchdog.update(bus.drives)
            asked.clear()
            with bus.torque(watchdog=0.1):
                servos(bus)[2].connected = False
                bus.exchange([0.0, 0.0])
                servos(bus)[2].connected = True
            report = bus.torque_off_report
            assert report is not None and report.is_off
            assert asked == ([2] if is_watched else []), "without a watchdog there was none to disarm"
            if is_watched:
                assert {joint.id for joint in report.rebooted} == rebooted
                assert {joint.id for joint in report.disarmed} == disarmed


@pytest.mark.parametrize(
    ("error", "own", "said"),
    [
        (HardwareError(0), True, "raised its alert, but reports no hardware error now"),
        (HardwareError(0), False, ""),
        (HardwareError.OVERLOAD, False, "overload. Its torque stays off"),
        (HardwareError.INPUT_VOLTAGE, True, "input voltage. Its Shutdown setting leaves its torque on"),
    ],
)
def test_a_fault_is_reported_of_the_servo_that_has_it(
    fake_config: Make, error: HardwareError, own: bool, said: str
) -> None:
    """One of two servos on a joint may report the other one's alert."""
    with ServoBus.open(fake_config()) as bus:
        second = tuple(bus.drives)[1]
        servos(bus)[2].memory.set("Hardware Error Status", int(error))
        found = bus._fault(second, its_own=own)
        assert said in found and bool(found) is bool(said)
