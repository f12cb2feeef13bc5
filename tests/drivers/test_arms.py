"""Arms beyond two equal servos on a fast adapter: pairs, mixed modes, turned encoders, slow and unusual adapters."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import serial

from hil import fakes
from hil.drivers.bus import BusConfig, ServoBus
from hil.drivers.errors import BusShared, NoReply, ServoFault, WrongSetting
from hil.drivers.joint import Joint, SecondServo
from hil.drivers.packet import HardwareError
from hil.drivers.rate import FixedRate
from hil.drivers.servo_model import Mode, servo_model
from hil.fakes.bus.faults import Fault, FaultKind
from hil.fakes.description import FakeArm
from hil.fakes.protocol_fake import FakeSerial, open_fake

LINK = {"length": 0.15, "mass": 0.2, "centre": 0.08, "inertia": 5e-4}
DRIVE = {"mass": 0.08, "rotor_inertia": 8e-8, "gear_ratio": 353.5, "torque_constant": 1.8, "viscous": 0.05}
XM430 = servo_model("XM430-W350")


def arm(*servos: dict[str, Any], joints: int = 2, start: tuple[float, ...] = (-1.57, 0.0), **more: Any) -> FakeArm:
    described = [{"id": number, "model": "XM430-W350", "zero_ticks": 2048} | s for number, s in enumerate(servos, 1)]
    return FakeArm.model_validate(
        {
            "servos": described,
            "arm": {"gravity": 0.0, "start": list(start), "links": [LINK] * joints, "drives": [DRIVE] * joints},
            **more,
        }
    )


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[ServoBus, FakeSerial]]:
    """Return a prepared bus onto a described arm, and the other end of its port."""

    def make(description: FakeArm, *joints: Joint, faults: tuple[Fault, ...] = (), **settings: Any) -> Any:
        port = open_fake(description)
        port.bus.faults.add(*faults)
        monkeypatch.setattr(serial, "serial_for_url", lambda *_, **__: port)
        return ServoBus.open(BusConfig("fake://arm", 1_000_000, joints, **settings)), port

    return make


Open = Callable[..., tuple[ServoBus, FakeSerial]]

PAIR = ({"joint": 1}, {"joint": 1, "direction": -1}, {})
SHOULDER = Joint("shoulder", 1, XM430, zero_ticks=2048, seconds=(SecondServo(2, -1),))
ELBOW = Joint("elbow", 3, XM430, zero_ticks=2048)


# Two servos on one joint


@pytest.mark.parametrize("fast", [True, False])
def test_a_pair_shares_its_goal_and_adds_its_currents(opened: Open, fast: bool) -> None:
    bus, port = opened(arm(*PAIR), SHOULDER, ELBOW, fast_sync_read=fast)
    with bus, bus.torque(watchdog=0.1):
        for _ in range(40):
            state = bus.exchange([0.4, 0.05])
            port.clock.wait_until(port.clock.now() + 2e-3)
        servos = port.bus.servos
        assert [servos[i].goal_current_ticks for i in (1, 2, 3)] == [74, -74, 19]
        assert state.goal_current == pytest.approx((0.4, 0.05), abs=3e-3)
        assert state.current == pytest.approx((0.4, 0.05), abs=6e-3)
        assert state.velocity[0] > 0.5
        assert len(state.position) == len(state.missing) == 2
    assert bus.torque_off_report is not None
    assert len(bus.torque_off_report.confirmed) == 3
    assert not any(servo.torque_enabled for servo in port.bus.servos.values())


def test_both_of_a_pair_are_watched(opened: Open) -> None:
    bus, port = opened(arm(*PAIR), SHOULDER, ELBOW, fast_sync_read=False)
    with bus:
        port.bus.servos[2].fail(HardwareError.OVERLOAD)
        with pytest.raises(ServoFault, match=r"Joint 'shoulder' \(ID 2, .*overload"):
            bus.check_alerts(bus.exchange([0.0, 0.0]))
        port.bus.servos[2].connected = False
        state = bus.exchange([0.0, 0.0])
        assert state.missing == (True, True)  # in a Sync Read, all servos after a silent one stay silent
        report = bus.torque_off()
        assert [str(joint) for joint, _ in report.unconfirmed] == ["joint 'shoulder' (ID 2, XM430-W350)"]


@pytest.mark.parametrize("servo", [1, 2])
def test_an_alert_of_a_pair_is_the_servo_s_that_raised_it_even_without_a_hardware_error(
    opened: Open, servo: int
) -> None:
    bus, port = opened(arm(*PAIR), SHOULDER, ELBOW)
    with bus:
        port.bus.faults.add(Fault(kind=FaultKind.STATUS_ERROR, at=port.bus.time, servo=servo, amount=128.0))
        state = bus.exchange([0.0, 0.0])
        port.bus.faults.clear()
        bus.exchange([0.0, 0.0])  # as happens while an arm is lowered
        with pytest.raises(ServoFault, match=rf"^Joint 'shoulder' \(ID {servo}, .*no hardware error now") as fault:
            bus.check_alerts(state)
        assert str(fault.value).count("raised its alert") == 1


def test_slow_registers_of_a_pair(opened: Open) -> None:
    bus, port = opened(arm(*PAIR), SHOULDER, ELBOW, slow_every=2)
    port.bus.servos[2].temperature_c = 51.0
    with bus:
        slow = [state.slow for state in (bus.exchange([0.0, 0.0]) for _ in range(8)) if state.slow]
    assert max(turn.temperature[0] for turn in slow if not math.isnan(turn.temperature[0])) == 51.0
    assert all(len(turn.tick) == 2 for turn in slow)


def test_a_shadow_is_refused_until_its_secondary_id_is_gone(opened: Open) -> None:
    shadowed = ({"joint": 1}, {"joint": 1, "direction": -1, "registers": {"Secondary(Shadow) ID": 1}}, {})
    with pytest.raises(WrongSetting, match=r"ID 2.*Secondary ID is 1.*--secondary-id 255"):
        opened(arm(*shadowed), SHOULDER, ELBOW)


def test_a_reversed_second_servo_is_refused_and_a_time_based_profile_is_not(opened: Open) -> None:
    with pytest.raises(WrongSetting, match="Drive Mode is 5"):
        opened(arm(PAIR[0], PAIR[1] | {"registers": {"Drive Mode": 5}}, {}), SHOULDER, ELBOW)
    opened(arm(PAIR[0], PAIR[1] | {"registers": {"Drive Mode": 4}}, {}), SHOULDER, ELBOW)[0].close()


ALONE = Joint("shoulder", 1, XM430, zero_ticks=2048), Joint("elbow", 2, XM430, zero_ticks=2048)


def test_a_homing_offset_that_the_change_of_mode_would_apply_is_refused(opened: Open) -> None:
    hidden = {"Homing Offset": 1025}
    with pytest.raises(WrongSetting, match=r"'elbow' .*Homing Offset is 1025. Position Control Mode ignores"):
        opened(arm({}, {"registers": hidden}), *ALONE)
    for accepted in ({"Homing Offset": 1024}, hidden | {"Operating Mode": 4}):
        opened(arm({}, {"registers": accepted}), *ALONE)[0].close()


# Current and PWM on one arm


def current_and_pwm() -> tuple[Any, ...]:
    """An arm of three joints that are driven by voltage, current and voltage."""
    models = ("XL430-W250", "XL330-M288", "XL430-W250")
    servos = [{"id": number, "model": model, "zero_ticks": 2048} for number, model in enumerate(models, start=1)]
    description = FakeArm.model_validate(
        {
            "servos": servos,
            "plant": "hil.fakes.plants.independent:make_plant",
            "plant_options": {"joints": [ONE] * 3},
        }
    )
    return (
        description,
        Joint("a", 1, servo_model("XL430-W250"), zero_ticks=2048, mode=Mode.PWM),
        Joint("b", 2, servo_model("XL330-M288"), -1, zero_ticks=2048),
        Joint("c", 3, servo_model("XL430-W250"), zero_ticks=2048, mode=Mode.PWM),
    )


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("one_write", [True, False])
@pytest.mark.parametrize("interval", [0.0, 0.01])
def test_current_and_pwm_joints_on_one_arm(opened: Open, fast: bool, one_write: bool, interval: float) -> None:
    bus, port = opened(*current_and_pwm(), fast_sync_read=fast, one_write=one_write, slow_every=5, interval=interval)
    with bus, bus.torque(watchdog=0.1):
        states = []
        for _ in range(60):
            states.append(bus.exchange([1.0, -0.1, -2.0]))
            port.clock.wait_until(port.clock.now() + 5e-3)
        servos = port.bus.servos
        assert [servos[1].value("Goal PWM"), servos[2].goal_current_ticks, servos[3].value("Goal PWM")] == [
            80,
            100,
            -159,
        ]
        last = states[-1]
        assert not any(last.missing)
        assert last.goal_current == pytest.approx((1.0, -0.1, -2.0), abs=0.01)
        assert last.current == pytest.approx((1.0, -0.1, -2.0), abs=0.1)
        assert [math.copysign(1, rate) for rate in last.velocity] == [1, -1, -1]
        assert {state.slow.voltage for state in states if state.slow and state.slow.voltage[0] == state.slow.voltage[0]}
        if interval:
            (told, *_) = [state.status for state in states if state.status]
            assert all(status and status.watchdog == 5 for status in told)
            assert [status.goal for status in told if status] == pytest.approx([1.0, -0.1, -2.0], abs=0.01)


@pytest.mark.parametrize("place", [1, 2, 3])
def test_another_master_is_found_on_current_and_pwm_joints_of_one_arm(opened: Open, place: int) -> None:
    """The XL430-W250 has no Goal Current: a read that ends there would be refused."""
    bus, port = opened(*current_and_pwm(), interval=0.01)
    with (
        bus,
        bus.torque(watchdog=0.1),
        pytest.raises(BusShared, match=f"ID {place}.* another program.* altered in transit"),
    ):
        for cycle in range(40):
            due = port.clock.now() + 0.01
            bus.exchange([0.01 * cycle] * 3)
            if cycle > 30:
                port.bus.servos[place].write(102 if place == 2 else 100, b"\x55\0")
            bus.check_not_overruled(due)
            port.clock.wait_until(due)


ONE = {"gravity": 0.0, "start": [0.0], "links": [LINK], "drives": [DRIVE | {"torque_constant": 0.4}]}


# The turn in which a joint starts


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("zero", [0, 10, 1024, 2048, 4090])
@pytest.mark.parametrize("rest", [-1.57, 0.0, 3.0])
def test_a_joint_starts_in_the_turn_in_which_it_hangs(opened: Open, direction: int, zero: int, rest: float) -> None:
    for off in (-0.1, 0.1):
        description = arm({"zero_ticks": zero, "direction": direction}, joints=1, start=(rest + off,))
        joint = Joint("one", 1, XM430, direction, zero, near=rest)
        bus, _ = opened(description, joint)
        with bus:
            assert bus.read_positions() == pytest.approx((rest + off,), abs=2e-3)
            assert bus.exchange([0.0]).position == pytest.approx((rest + off,), abs=2e-3)


def test_without_an_idea_of_the_pose_present_position_is_believed(opened: Open) -> None:
    bus, _ = opened(arm({"zero_ticks": 0}, joints=1, start=(-0.1,)), Joint("one", 1, XM430, zero_ticks=0))
    with bus:
        assert bus.read_positions() == pytest.approx((math.tau - 0.1,), abs=2e-3)


# Slow and unusual adapters


@pytest.mark.parametrize("latency_us", [1_000.0, 16_000.0, 45_000.0, 90_000.0])
def test_slow_adapters_are_waited_for(opened: Open, latency_us: float) -> None:
    joints = Joint("a", 1, XM430), Joint("b", 2, XM430)
    bus, port = opened(arm({}, {}, adapter_latency_us=latency_us), *joints)
    with bus, bus.torque(watchdog=0.5):
        start = port.clock.now()
        assert bus.exchange([0.1, 0.1]).missing == (False, False)
        assert port.clock.now() - start == pytest.approx(latency_us * 1e-6, abs=2e-3)


def test_a_servo_that_is_not_there_is_no_slow_adapter(opened: Open) -> None:
    with pytest.raises(NoReply):
        opened(arm({}, joints=1, start=(0.0,)), Joint("a", 7, XM430))


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("one_write", [True, False])
def test_an_adapter_that_echoes(opened: Open, fast: bool, one_write: bool) -> None:
    joints = Joint("a", 1, XM430), Joint("b", 2, XM430)
    bus, port = opened(arm({}, {}, adapter_echoes=True), *joints, fast_sync_read=fast, one_write=one_write)
    assert bus.port.echoes
    with bus, bus.torque(watchdog=0.1):
        states = [bus.exchange([0.1, -0.1]) for _ in range(30)]
        assert not any(any(state.missing) for state in states)
        assert [port.bus.servos[i].goal_current_ticks for i in (1, 2)] == [37, -37]
    assert bus.torque_off_report is not None
    assert not bus.torque_off_report.unconfirmed


def test_an_echo_and_a_lost_reply(opened: Open) -> None:
    joints = Joint("a", 1, XM430), Joint("b", 2, XM430)
    bus, port = opened(arm({}, {}, adapter_echoes=True), *joints)
    with bus:
        port.bus.faults.add(Fault(kind="lost_reply", duration=0.001, at=port.bus.time))
        assert any(bus.exchange([0.0, 0.0]).missing)
        port.bus.faults.clear()
        assert bus.exchange([0.0, 0.0]).missing == (False, False)


@pytest.mark.parametrize("echoes", [False, True])
@pytest.mark.parametrize(("silent", "hides"), [(1, True), (2, False), (None, False)])
def test_a_silent_first_servo_is_told_from_a_silent_arm(
    opened: Open, echoes: bool, silent: int | None, hides: bool
) -> None:
    joints = Joint("a", 1, XM430), Joint("b", 2, XM430)
    bus, port = opened(arm({}, {}, adapter_echoes=echoes), *joints)
    with bus:
        port.bus.faults.add(Fault(kind="silent_servo", servo=silent, at=port.bus.time))
        assert bus.first_hides_others(0.02) is hides


# Another master


def test_another_master_is_heard_before_anything_moves(opened: Open) -> None:
    joints = Joint("a", 1, XM430), Joint("b", 2, XM430)
    with pytest.raises(BusShared, match="is sending instructions to ID 2"):
        opened(arm({}, {}), *joints, faults=(Fault(kind="other_master", servo=2, amount=0.02),))


def test_another_master_that_comes_later_ends_the_exchange(opened: Open) -> None:
    joints = Joint("a", 1, XM430), Joint("b", 2, XM430)
    bus, port = opened(arm({}, {}), *joints)
    with bus, pytest.raises(BusShared, match="Another master has sent"), bus.torque(watchdog=0.1):
        port.bus.faults.add(Fault(kind="other_master", servo=1, amount=0.0031, at=port.bus.time + 0.05))
        for _ in range(2000):
            bus.exchange([0.0, 0.0])
            port.clock.wait_until(port.clock.now() + 2e-3)
    assert not any(servo.torque_enabled for servo in port.bus.servos.values())


def test_fakes_register_knows_the_url_that_the_driver_is_given() -> None:
    fakes.register()
    with ServoBus.open(BusConfig("fake://fake_two_link", 1_000_000, (Joint("a", 1, XM430, zero_ticks=3072),))) as bus:
        assert bus.read_positions() == pytest.approx((-math.pi / 2,), abs=2e-3)


@pytest.mark.parametrize("fast", [True, False])
def test_six_servos_with_shadows_hold_400_hz_at_1_mbaud(opened: Open, fast: bool) -> None:
    servos = ({"joint": 1}, {"joint": 1, "direction": -1}, {"joint": 2}, {"joint": 2, "direction": -1}, {}, {})
    described = {
        "servos": [{"id": n, "model": "XM540-W270", "zero_ticks": 2048} | s for n, s in enumerate(servos, 1)],
        "plant": "hil.fakes.plants.independent:make_plant",
        "plant_options": {"joints": [ONE] * 4},
        "adapter_latency_us": 60.0,
    }
    xm540 = servo_model("XM540-W270")
    joints = (
        Joint("a", 1, xm540, zero_ticks=2048, seconds=(SecondServo(2, -1),)),
        Joint("b", 3, xm540, zero_ticks=2048, seconds=(SecondServo(4, -1),)),
        Joint("c", 5, xm540, zero_ticks=2048),
        Joint("d", 6, xm540, zero_ticks=2048),
    )
    bus, port = opened(FakeArm.model_validate(described), *joints, fast_sync_read=fast, interval=1 / 400)
    rate = FixedRate(port.clock, 400.0)
    with bus, bus.torque(watchdog=0.1):
        for _ in range(400):
            assert not rate.wait().missed
            assert not any(bus.exchange([0.02] * 4).missing)
    assert rate.missed == 0


# Late replies


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize(("model", "mode"), [("XM430-W350", Mode.CURRENT), ("XL430-W250", Mode.PWM)])
def test_a_late_reply_is_recognised_by_its_length_whatever_it_answers(
    opened: Open, model: str, mode: Mode, fast: bool
) -> None:
    """The state of a servo in PWM mode has two bytes more than that of one in current mode."""
    named = ((1, "shoulder"), (2, "elbow"))
    joints = [Joint(name, number, servo_model(model), zero_ticks=2048, mode=mode) for number, name in named]
    bus, _ = opened(arm({"model": model}, {"model": model}), *joints, fast_sync_read=fast)
    back = bus.prepared._read_back
    assert back is not None
    sizes = [read.reply_size for read in (*(plan.read for plan in bus.prepared._plans), *back.reads)]
    assert len(set(sizes)) == len(sizes)
