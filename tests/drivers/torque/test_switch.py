"""Switching torque on and off, as seen by the emulated servos."""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import BusShared, ServoRefused, TorqueNotOff
from hil.drivers.preparation.settings import put_back, read_settings
from hil.fakes.bus.faults import Fault, FaultKind
from tests.support.bench import servos

Make = Callable[..., BusConfig]
GOAL_CURRENT, WATCHDOG, TORQUE = 102, 98, 64


def fake_bus(bus: ServoBus) -> Any:
    fake: Any = bus.port
    return fake._serial.bus


def written(bus: ServoBus, servo_id: int, monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int, float]]:
    """Record all later writes to a servo in the list returned: address, value, time [s]."""
    servo = servos(bus)[servo_id]
    write = servo.write
    seen: list[tuple[int, int, float]] = []

    def writing(address: int, data: bytes) -> int:
        seen.append((address, int.from_bytes(data, "little", signed=True), bus.port.clock.now()))
        error: int = write(address, data)
        return error

    monkeypatch.setattr(servo, "write", writing)
    return seen


@pytest.mark.parametrize("servo_id", [1, 2])
def test_goal_current_is_zero_and_the_watchdog_armed_before_torque_comes_on(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch, servo_id: int
) -> None:
    with ServoBus.open(fake_config()) as bus:
        servos(bus)[servo_id].write(GOAL_CURRENT, (1000).to_bytes(2, "little"))
        seen = written(bus, servo_id, monkeypatch)
        with bus.torque(watchdog=0.1):
            order = [(address, value) for address, value, _ in seen]
        assert order.index((GOAL_CURRENT, 0)) < order.index((TORQUE, 1))
        assert order.index((WATCHDOG, 5)) < order.index((TORQUE, 1))
        assert not servos(bus)[servo_id].torque_enabled


def test_late_replies_before_torque_came_on_are_forgotten(fake_config: Make) -> None:
    """After a stop, late replies explain missing ones."""
    with ServoBus.open(fake_config()) as bus:
        bus.port.late_replies = 3
        with bus.torque(watchdog=0.1):
            assert bus.port.late_replies == 0


def test_a_servo_that_answers_pings_only_is_made_to_answer_and_confirmed_off(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        with bus.torque(watchdog=0.1):
            servos(bus)[2].write(68, b"\0")
        report = bus.torque_off_report
        assert report is not None and not report.unconfirmed
        assert servos(bus)[2].value("Status Return Level") == 2
        assert list(bus.drives.values())[1].answered_pings_only


def refusing(bus: ServoBus, servo_id: int, refused: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A servo that answers a write without an error but ignores it."""
    servo = servos(bus)[servo_id]
    write = servo.write

    def writing(address: int, data: bytes) -> int:
        if (address, int.from_bytes(data, "little")) == refused:
            return 0
        error: int = write(address, data)
        return error

    monkeypatch.setattr(servo, "write", writing)


def test_no_torque_where_the_watchdog_does_not_read_back_as_armed(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:
        refusing(bus, 2, (WATCHDOG, 5), monkeypatch)
        said = r"'elbow'.*Bus Watchdog was written as 5 but reads back as 0"
        with pytest.raises(ServoRefused, match=said), bus.torque(watchdog=0.1):
            raise AssertionError("torque is on")
        assert not any(servo.torque_enabled for servo in servos(bus).values())


def test_a_servo_that_keeps_its_torque_though_it_answers_is_named(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:
        said = r"NOT CONFIRMED for JOINT 'ELBOW' \(ID 2.*reads back as 1.*cut the power"
        with pytest.raises(TorqueNotOff, match=said), bus.torque(watchdog=0.1):
            refusing(bus, 2, (TORQUE, 0), monkeypatch)
        assert not servos(bus)[1].torque_enabled
        bus.port.clock.wait_until(bus.port.clock.now() + 0.11)
        assert servos(bus)[2].watchdog_tripped, "the watchdog was left active"


def test_a_silent_servo_and_a_lost_packet_do_not_keep_the_other_one_waiting(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While a silent servo is polled repeatedly, the packets feed the other servos' watchdogs."""
    with ServoBus.open(fake_config()) as bus:
        with pytest.raises(TorqueNotOff, match="'SHOULDER'"), bus.torque(watchdog=0.1):
            bus.exchange([0.3, 0.3])
            seen = written(bus, 2, monkeypatch)
            servos(bus)[1].connected = False
            left = bus.port.clock.now()
            faults = fake_bus(bus).faults
            faults.add(Fault(kind=FaultKind.LOST_INSTRUCTION, at=fake_bus(bus).time, duration=2e-4))
        assert any(fault.kind == FaultKind.LOST_INSTRUCTION for fault in faults.happened)
        off = next(time for address, value, time in seen if (address, value) == (TORQUE, 0))
        assert off - left < 0.002


@pytest.fixture
def _interrupts() -> Iterator[None]:
    """Deliver Ctrl-C as to a program without its own signal handlers; a test runner's workers ignore it."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.usefixtures("_interrupts")
@pytest.mark.parametrize("after", [0, 1, 2, 5])
def test_an_interrupt_while_torque_is_cut_waits_until_it_is_cut(fake_config: Make, after: int) -> None:
    """The driver is used as a library, without signal handlers that merely set a flag."""
    with ServoBus.open(fake_config()) as bus:
        send = bus.port.write
        left = [after]

        def interrupted(data: bytes) -> None:
            send(data)
            left[0] -= 1
            if left[0] == -1:
                os.kill(os.getpid(), signal.SIGINT)

        with pytest.raises(KeyboardInterrupt), bus.torque(watchdog=0.1):
            bus.port.write = interrupted  # type: ignore[method-assign]
        assert not any(servo.torque_enabled for servo in servos(bus).values())
        assert bus.torque_off_report is not None and not bus.torque_off_report.unconfirmed


@pytest.mark.parametrize("after", [0, 1, 3])
def test_an_interrupt_that_no_shield_holds_back_leaves_no_servo_untried(fake_config: Make, after: int) -> None:
    with ServoBus.open(fake_config()) as bus:
        send = bus.port.write
        left = [after]

        def interrupted(data: bytes) -> None:
            left[0] -= 1
            if left[0] == -1:
                raise KeyboardInterrupt
            send(data)

        with pytest.raises(KeyboardInterrupt), bus.torque(watchdog=0.1):
            bus.port.write = interrupted  # type: ignore[method-assign]
        assert not any(servo.torque_enabled for servo in servos(bus).values())
        assert bus.torque_off_report is not None and not bus.torque_off_report.unconfirmed


def test_an_interrupt_before_the_shield_is_up_is_met_by_a_second_attempt(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:
        cut, called = bus.torque_off, []

        def first_interrupted() -> Any:
            called.append(True)
            if len(called) == 1:
                raise KeyboardInterrupt
            return cut()

        monkeypatch.setattr(bus, "torque_off", first_interrupted)
        with pytest.raises(KeyboardInterrupt), bus.torque(watchdog=0.1):
            pass
        assert not any(servo.torque_enabled for servo in servos(bus).values())


def refuse_everything(bus: ServoBus) -> None:
    fake_bus(bus).faults.add(Fault(kind=FaultKind.STATUS_ERROR, at=fake_bus(bus).time, servo=2))


def take_another_id(bus: ServoBus) -> None:
    servo = servos(bus)[2]
    servo.memory.set("ID", 77)
    servo._derive()


@pytest.mark.parametrize("happens", [refuse_everything, take_another_id])
def test_a_servo_that_hears_and_does_not_obey_is_stopped_by_its_watchdog(
    fake_config: Make, happens: Callable[[ServoBus], None]
) -> None:
    """Every query feeds its watchdog: a servo that did not answer the last exchange is not addressed."""
    with ServoBus.open(fake_config()) as bus:
        with contextlib.suppress(TorqueNotOff), bus.torque(watchdog=0.08):
            bus.exchange([0.3, 0.3])
            driven = servos(bus)
            happens(bus)
            bus.exchange([0.3, 0.3])
            begun = bus.port.clock.now()
            disobedient = driven[2]
            trip = disobedient.trip_watchdog
            when: list[float] = []

            def tripping() -> None:
                when.append(disobedient.heard_at + disobedient.watchdog_s - begun)
                trip()

            disobedient.trip_watchdog = tripping
        assert when and when[0] <= 0.08 + 0.015
        assert not driven[1].torque_enabled and disobedient.watchdog_tripped
        assert bus.torque_off_report is not None
        assert [joint.id for joint, _ in bus.torque_off_report.unconfirmed] == [2]


def test_torque_off_that_meets_a_reply_on_the_wire_is_sent_again(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        with contextlib.suppress(TorqueNotOff), bus.torque(watchdog=0.08):
            bus.exchange([0.3, 0.3])
            driven = servos(bus)
            fake_bus(bus).faults.add(Fault(kind=FaultKind.LOST_REPLY, at=fake_bus(bus).time))
            bus.exchange([0.3, 0.3])
            begun = bus.port.clock.now()
            seen = [written(bus, servo_id, pytest.MonkeyPatch()) for servo_id in (1, 2)]
            lost = Fault(kind=FaultKind.LOST_INSTRUCTION, at=fake_bus(bus).time, duration=2e-3)
            fake_bus(bus).faults.add(lost)
        for each in seen:
            assert next(time for address, value, time in each if (address, value) == (TORQUE, 0)) - begun < 0.01
        assert not any(servo.torque_enabled for servo in driven.values())


def test_all_servos_confirmed_takes_no_silence(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        with bus.torque(watchdog=0.08):
            bus.exchange([0.3, 0.3])
            begun = bus.port.clock.now()
        assert bus.port.clock.now() - begun < 0.03


def test_torque_that_reads_0_is_off_whatever_error_the_replies_report(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:
        servo = bus.drives[bus.joints[1]]
        settings = read_settings(servo)
        ask = servo._sdk.txRxPacket
        with bus.torque(watchdog=0.1):
            monkeypatch.setattr(servo._sdk, "txRxPacket", lambda *packet: (*ask(*packet)[:2], 4))
        assert bus.torque_off_report is not None and not bus.torque_off_report.unconfirmed
        assert put_back(servo, {**settings, "Goal Current": 7}) == {"Goal Current": (0, 7)}
        with pytest.raises(ServoRefused, match="data range"):
            servo.read("Goal Current")


def test_watchdogs_are_shortened_in_one_packet_and_never_prolonged(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus, bus.torque(watchdog=0.08):
        seen = [written(bus, servo_id, monkeypatch) for servo_id in (1, 2)]
        for seconds in (0.1, 0.08):
            bus.shorten_watchdogs(seconds)
        assert seen == [[], []]
        bus.shorten_watchdogs(0.04)
        bus.port.clock.wait_until(bus.port.clock.now() + 0.01)
        bus.exchange([0.0, 0.0])
        for servo_id, each in zip((1, 2), seen, strict=True):
            assert (WATCHDOG, 2) in [(address, value) for address, value, _ in each]
            assert servos(bus)[servo_id].value("Bus Watchdog") == 2


SWITCHED_ON = r"'elbow'.* A\): torque was off and has been switched on by another program"


def test_torque_that_another_program_has_switched_on_is_cut_and_named(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        servos(bus)[2].write(TORQUE, b"\1")
        with pytest.raises(BusShared, match=SWITCHED_ON), bus.torque(watchdog=0.1):
            pytest.fail("torque came on")
        assert not any(servo.torque_enabled for servo in servos(bus).values())
        assert str(bus.torque_off_report) == "Torque is off on both servos, confirmed by reading it back."


def test_torque_that_comes_on_while_waiting_is_cut_at_once(fake_config: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    with ServoBus.open(fake_config()) as bus:
        clock, on_at = bus.port.clock, bus.port.clock.now() + 1.0
        wait = clock.wait_until
        times: list[float] = []

        def waiting(until: float) -> None:
            wait(until)
            if clock.now() >= on_at and not times:
                times.append(clock.now())
                servos(bus)[2].write(TORQUE, b"\1")

        monkeypatch.setattr(clock, "wait_until", waiting)
        with pytest.raises(BusShared, match=SWITCHED_ON):
            bus.wait_switched_off(clock.now() + 10.0)
        assert clock.now() < on_at + 0.5
        assert not any(servo.torque_enabled for servo in servos(bus).values())


@pytest.mark.parametrize(("watchdog", "ticks"), [(0.02, 1), (2.54, 127), (0.01, None), (2.56, None)])
def test_a_watchdog_can_be_set_to_between_20_ms_and_2_54_s(
    fake_config: Make, watchdog: float, ticks: int | None
) -> None:
    with ServoBus.open(fake_config()) as bus:
        if ticks is None:
            with pytest.raises(ValueError, match=r"watchdog must be 0\.02 to 2\.54 s"), bus.torque(watchdog):
                pass
        else:
            with bus.torque(watchdog):
                assert servos(bus)[1].value("Bus Watchdog") in (ticks, 255)
        assert not any(servo.torque_enabled for servo in servos(bus).values())


def test_torque_is_looked_at_ten_times_a_second_while_the_program_waits(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:
        clock, looks = bus.port.clock, []

        def looking(_: Any) -> str:
            looks.append(clock.now())
            assert len(looks) < 50, "time does not pass"
            return ""

        monkeypatch.setattr("hil.drivers.torque.switch.switched_on", looking)
        begun = clock.now()
        bus.wait_switched_off(begun + 1.0)
        assert [each - begun for each in looks] == pytest.approx([0.1 * number for number in range(11)], abs=0.005)


def test_an_interrupt_while_another_programs_torque_is_cut_is_raised_afterwards(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus:

        def interrupted(*words: Any) -> tuple[tuple[()], tuple[()]]:
            words[-1].extend([KeyboardInterrupt("first"), KeyboardInterrupt("second")])
            return (), ()

        monkeypatch.setattr("hil.drivers.torque.switch.cut_torque", interrupted)
        with pytest.raises(KeyboardInterrupt, match="first"):
            bus.cut_foreign_torque(list(bus.drives))
        monkeypatch.undo()
