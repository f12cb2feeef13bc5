"""ServoBus on the fake arm in virtual time: preparation, messages, and the effect of a lost reply."""

from collections.abc import Callable

import pytest

from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import NoReply, PortLost, ServoFault, ServoRefused, WrongReply, WrongSetting
from hil.drivers.joint import Joint
from hil.drivers.packet import HardwareError
from hil.drivers.port import Port
from hil.drivers.servo_model import Mode, servo_model
from tests.support.bench import servos

from .conftest import JOINTS

Make = Callable[..., BusConfig]
File = Callable[..., str]


def test_opened_means_ready_for_an_exchange_and_without_torque(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        state = bus.exchange([0.0, 0.0])
        assert state.missing == (False, False)
        assert state.position == pytest.approx((-1.5708, 0.0), abs=2e-3)
        assert not any(servo.torque_enabled for servo in servos(bus).values())
    assert not bus.port.is_open


@pytest.mark.parametrize("latency_us", [900, 1800, 2400, 4000])
def test_no_reply_is_lost_whatever_the_adapters_delay_and_its_former_timer(
    fake_config: Make, fake_file: File, monkeypatch: pytest.MonkeyPatch, latency_us: int
) -> None:
    monkeypatch.setattr("hil.drivers.port.port.adapter_latency", lambda _: 0.016)
    monkeypatch.setattr(Port, "lower_latency", lambda port: setattr(port, "latency", 1e-3))
    url = fake_file(("adapter_latency_us = 60.0", f"adapter_latency_us = {latency_us}"))
    with ServoBus.open(fake_config(url, interval=4e-3)) as bus:
        assert not any(any(bus.exchange([0.0, 0.0]).missing) for _ in range(50))


def test_a_servo_that_answers_pings_only_is_said_to(fake_config: Make) -> None:
    with ServoBus.connect(fake_config()) as bus:
        servos(bus)[2].write(68, b"\0")
        with pytest.raises(NoReply, match=r"'elbow' \(ID 2.*answers pings but not reads: its Status Return Level"):
            bus.check_identity()


def test_a_failed_opening_leaves_the_port_closed(
    fake_config: Make, fake_file: File, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []
    monkeypatch.setattr(ServoBus, "close", lambda bus: (closed.append(bus), bus.port.close()))
    url = fake_file(("[[fake.servos]]\nid = 1\n", '[[fake.servos]]\nid = 1\nregisters = { "Drive Mode" = 8 }\n'))
    with pytest.raises(WrongSetting, match=r"'shoulder' \(ID 1.*Drive Mode is 8"):
        ServoBus.open(fake_config(url))
    assert len(closed) == 1 and not closed[0].port.is_open


@pytest.mark.parametrize(("firmware", "fast"), [(44, False), (45, True)])
def test_fast_sync_read_is_used_where_every_firmware_has_it(
    fake_config: Make, fake_file: File, firmware: int, fast: bool
) -> None:
    url = fake_file(("[[fake.servos]]\nid = 2\n", f"[[fake.servos]]\nid = 2\nfirmware = {firmware}\n"))
    with ServoBus.open(fake_config(url)) as bus:
        assert bus.prepared.fast is fast
        assert bus.exchange([0.0, 0.0]).missing == (False, False)


def test_servos_that_answer_with_each_others_id_end_the_exchange(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus, pytest.raises(WrongReply, match=r"IDs 2, 1, although each .* `hil scan"):
        monkeypatch.setattr(bus.prepared.heard, "senders", [2, 1])
        for count in (2, 3):
            monkeypatch.setattr(bus.prepared.heard, "mixed_up", count)
            bus.exchange([0.0, 0.0])
            assert count == 2


@pytest.mark.parametrize("noise", ["fffffd00", "fffffd00020c005500", "fffffd0002fa0055"])
def test_what_begins_like_a_packet_before_each_reply_does_not_prevent_settings(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch, noise: str
) -> None:
    with ServoBus.connect(fake_config()) as bus:
        servo = bus.servo(bus.joints[1])
        write, read, pending = bus.port.write, bus.port.read, [b""]

        def noisy_write(data: bytes) -> None:
            pending[0] = bytes.fromhex(noise)
            write(data)

        def noisy_read(count: int, timeout: float) -> bytes:
            first, pending[0] = pending[0][:count], pending[0][count:]
            return first or read(count, timeout)

        monkeypatch.setattr(bus.port, "write", noisy_write)
        monkeypatch.setattr(bus.port, "read", noisy_read)
        before = bus.port.clock.now()
        servo.write("Operating Mode", 0)
        assert servo.read("Operating Mode") == 0
        assert bus.port.clock.now() - before < 0.01, "no wait for what the noise announces"


def test_fast_sync_read_can_be_forbidden(fake_config: Make) -> None:
    with ServoBus.open(fake_config(fast_sync_read=False)) as bus:
        assert not bus.prepared.fast


def test_a_firmware_that_should_have_it_and_does_not_answer_is_read_the_old_way(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hil.fakes.bus.instructions import Instructions

    monkeypatch.setattr(Instructions, "_fast_sync_read", lambda *_: None)
    with ServoBus.open(fake_config()) as bus:
        assert not bus.prepared.fast
        assert bus.exchange([0.0, 0.0]).missing == (False, False)


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("one_write", [True, False])
def test_every_way_of_sending_drives_the_arm(fake_config: Make, fast: bool, one_write: bool) -> None:
    with (
        ServoBus.open(fake_config(fast_sync_read=fast, one_write=one_write)) as bus,
        bus.torque(watchdog=0.1),
    ):
        for _ in range(100):
            state = bus.exchange([0.3, 0.0])
        assert state.current[0] == pytest.approx(0.3, abs=0.01)
        assert state.position[0] > -1.56


@pytest.mark.parametrize("fast", [True, False])
def test_a_lost_reply_costs_three_milliseconds_one_sample_and_nothing_more(fake_config: Make, fast: bool) -> None:
    with ServoBus.open(fake_config(fast_sync_read=fast)) as bus:
        for lost in (1, 2):
            servos(bus)[lost].connected = False
            state = bus.exchange([0.0, 0.0])
            assert True in state.missing
            assert state.time_after_read - state.time_before_write <= 3e-3
            servos(bus)[lost].connected = True
            for _ in range(3):
                state = bus.exchange([0.0, 0.0])
                assert state.missing == (False, False)
                assert state.position == pytest.approx((-1.5708, 0.0), abs=2e-3)


def test_tick_voltage_and_temperature_come_in_turn(fake_config: Make) -> None:
    with ServoBus.open(fake_config(slow_every=5)) as bus:
        states = [bus.exchange([0.0, 0.0]) for _ in range(20)]
    slow = [state.slow for state in states if state.slow is not None]
    (first, *_) = turns = [index for index, state in enumerate(states) if state.slow]
    assert turns == [first, first + 5, first + 10, first + 15]
    assert slow[0].tick[0] == pytest.approx(states[first].time_before_write, abs=2e-3)
    assert slow[1].voltage == pytest.approx((12.0, 12.0))
    assert slow[1].temperature == (35.0, 35.0)
    assert all(state.position == pytest.approx((-1.5708, 0.0), abs=2e-3) for state in states)


def test_an_alert_is_followed_up_by_its_cause(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        servos(bus)[2].fail(HardwareError.OVERLOAD | HardwareError.OVERHEATING)
        state = bus.exchange([0.0, 0.0])
        with pytest.raises(ServoFault, match=r"'elbow' \(ID 2, XM430-W350\) .*: overheating, overload\..*rebooted"):
            bus.check_alerts(state)


def test_no_alert_no_question(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        state = bus.exchange([0.0, 0.0])
        before = bus.port.clock.now()
        bus.check_alerts(state)
        assert bus.port.clock.now() == before


@pytest.mark.parametrize("goals", [[float("nan"), 0.0], [0.0, float("inf")], [0.0], [0.0, 0.0, 0.0]])
def test_no_goal_that_is_no_number_is_sent(fake_config: Make, goals: list[float]) -> None:
    with ServoBus.open(fake_config()) as bus:
        before = bus.port.clock.now()
        with pytest.raises(ValueError, match="goal"):
            bus.exchange(goals)
        assert bus.port.clock.now() == before


def test_servos_that_do_not_confirm_writes_are_driven_and_let_go_all_the_same(fake_config: Make) -> None:
    with ServoBus.connect(fake_config()) as bus:
        for joint in bus.joints:
            bus.servo(joint).write("Status Return Level", 1)
        bus.prepare()
        with bus.torque(watchdog=0.5):
            assert all(servo.torque_enabled for servo in servos(bus).values())
        assert not any(servo.torque_enabled for servo in servos(bus).values())


def test_a_register_that_does_not_take_a_value_is_refused(fake_config: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    with ServoBus.connect(fake_config()) as bus:
        servo = bus.servo(bus.joints[0])
        monkeypatch.setattr(servo, "write_only", lambda *_: None)
        with pytest.raises(ServoRefused, match=r"Bus Watchdog was written as 5 but reads back as 0"):
            servo.write("Bus Watchdog", 5)


def test_a_watchdog_that_has_tripped_is_cleared_before_the_next_start(fake_config: Make) -> None:
    with ServoBus.open(fake_config()) as bus:
        for joint in bus.joints:
            bus.servo(joint).write("Torque Enable", 1)
            bus.servo(joint).write("Bus Watchdog", 5)
        # As after a program that was killed.
        bus.port.clock.wait_until(bus.port.clock.now() + 0.2)
        assert all(servo.watchdog_tripped for servo in servos(bus).values())
        bus.release_held(bus.joints)
        with bus.torque(watchdog=0.1):
            bus.exchange([0.1, 0.0])
            assert all(servo.torque_enabled and not servo.watchdog_tripped for servo in servos(bus).values())
        assert not any(servo.watchdog_tripped for servo in servos(bus).values())


def test_the_first_packet_of_a_stop_takes_torque_off_everywhere(
    fake_config: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ServoBus.open(fake_config()) as bus, bus.torque(watchdog=0.5):
        write = bus.port.write
        written = []

        def only_one(data: bytes) -> None:
            written.append(data)
            if len(written) > 1:
                raise PortLost("pulled")
            write(data)

        monkeypatch.setattr(bus.port, "write", only_one)
        report = bus.torque_off()
        assert not any(servo.torque_enabled for servo in servos(bus).values())
        assert [joint.name for joint, _ in report.unconfirmed] == ["shoulder", "elbow"]
        assert "SHOULDER" in str(report).upper() and "TORQUE OFF IS NOT CONFIRMED" in str(report)
        monkeypatch.undo()


@pytest.mark.parametrize(("watchdog", "ticks"), [(0.02, 1), (2.54, 127)])
def test_the_shortest_and_the_longest_watchdog(fake_config: Make, watchdog: float, ticks: int) -> None:
    with ServoBus.open(fake_config()) as bus, bus.torque(watchdog):
        assert [servo.read(98, 1)[1][0] for servo in servos(bus).values()] == [ticks, ticks]


@pytest.mark.parametrize("watchdog", [0.0, 0.009, 2.56])
def test_a_watchdog_that_no_servo_can_keep_is_refused_before_torque(fake_config: Make, watchdog: float) -> None:
    with ServoBus.open(fake_config()) as bus:
        with pytest.raises(ValueError, match=r"0\.02 to 2\.54 s"), bus.torque(watchdog):
            raise AssertionError("torque came on")
        assert not any(servo.torque_enabled for servo in servos(bus).values())


# PWM


def pwm(name: str, servo_id: int, zero: int) -> Joint:
    return Joint(name, servo_id, servo_model("XL430-W250"), zero_ticks=zero, mode=Mode.PWM)


def test_servos_without_a_current_sensor_are_driven_by_voltage(fake_config: Make, fake_file: File) -> None:
    url = fake_file(('model = "XM430-W350"', 'model = "XL430-W250"'))
    joints = (pwm("shoulder", 1, 3072), pwm("elbow", 2, 2048))
    with ServoBus.open(fake_config(url, joints)) as bus, bus.torque(watchdog=0.1):
        state = bus.exchange([3.0, -1.5])
        assert state.goal_current == pytest.approx((3.0, -1.5), abs=11.1 / 885)
        sent = {servo_id: servo.read(100, 2)[1] for servo_id, servo in servos(bus).items()}
        # Goal PWM is a share of the supply, which is 11.1 V here.
        assert int.from_bytes(sent[1], "little", signed=True) == round(3.0 / 11.1 * 885)
        assert int.from_bytes(sent[2], "little", signed=True) == round(-1.5 / 11.1 * 885)
        assert state.position == pytest.approx((-1.5708, 0.0), abs=2e-3)


def test_a_servo_without_current_mode_is_not_driven_by_current() -> None:
    with pytest.raises(ValueError, match=r"XL430-W250\) has no current mode; drive it in PWM mode"):
        Joint("elbow", 2, servo_model("XL430-W250"))


def test_ids_of_one_bus_differ() -> None:
    with pytest.raises(ValueError, match="IDs are 1, 1"):
        BusConfig("fake://", 1_000_000, (JOINTS[0], pwm("elbow", 1, 0)))
