"""Operating modes: whether a move is realistic, and whether gains, limits and profiles have the documented effect."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from hil.drivers.packet import encode
from hil.fakes.bus.bus import FakeBus
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.servo.registers import load_model
from hil.fakes.servo.servo import EmulatedServo
from hil.fakes.servo.trajectory import Trajectory, profile

Make = Callable[..., Any]

RPM = 0.229 * math.tau / 60  # rad/s per tick of velocity


class Shaft:
    """A motor with an ideal current loop that turns an inertia with some friction."""

    joints = 1

    def __init__(self, inertia: float = 0.012, torque_constant: float = 1.78, viscous: float = 0.03) -> None:
        self.time = 0.0
        self.position, self.velocity, self.current = [0.0], [0.0], [0.0]
        self._inertia, self._kt, self._viscous = inertia, torque_constant, viscous
        self.load = 0.0

    def advance(self, until: float, current: Any) -> None:
        while self.time < until - 1e-12:
            step = min(2e-4, until - self.time)
            torque = self._kt * current[0] - self._viscous * self.velocity[0] - self.load
            self.velocity[0] += step * torque / self._inertia
            self.position[0] += step * self.velocity[0]
            self.time += step
        self.current[0] = current[0]


class Rig:
    """One servo on a shaft; writes registers by name and simulates it over time."""

    def __init__(self, mode: int, model: str = "XM430-W350", **registers: int) -> None:
        self.clock = VirtualClock()
        self.shaft = Shaft()
        named = {key.replace("_", " "): value for key, value in registers.items()}
        self.servo = EmulatedServo(load_model(model), 1, zero_ticks=2048, registers={"Operating Mode": mode, **named})
        self.bus = FakeBus([self.servo], self.shaft, self.clock)

    def write(self, name: str, value: int) -> None:
        register = self.servo.memory.registers[name]
        body = register.address.to_bytes(2, "little")
        body += value.to_bytes(register.size, "little", signed=register.signed)
        self.bus.write(encode(1, 3, body))
        status = self.bus.read(11, 0.01)
        assert status[8] == 0, f"{name} = {value}: error {status[8]}"

    def read(self, name: str) -> int:
        register = self.servo.memory.registers[name]
        self.bus.write(encode(1, 2, register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")))
        raw = self.bus.read(11 + register.size, 0.01)
        assert raw[8] & 0x7F == 0
        return int.from_bytes(raw[9:-2], "little", signed=register.signed)

    def run(self, seconds: float) -> None:
        end = self.clock.now() + seconds
        while self.clock.now() < end:
            self.clock.wait_until(min(end, self.clock.now() + 0.01))
            self.bus.advance(self.clock.now())


def test_position_move_arrives_and_stays() -> None:
    rig = Rig(3)
    rig.write("Torque Enable", 1)
    assert rig.servo.value("Goal Position") == 2048  # no jump when torque comes on
    rig.run(0.2)
    assert rig.read("Present Position") == 2048
    rig.write("Goal Position", 3072)
    rig.run(0.1)
    assert rig.read("Moving") == 1
    assert 2100 < rig.read("Present Position") < 3072
    rig.run(1.5)
    assert abs(rig.read("Present Position") - 3072) <= 4
    assert rig.read("Moving") == 0
    assert rig.read("Moving Status") & 1


def test_a_motor_that_holds_a_load_stays_when_its_turns_are_cleared() -> None:
    rig = Rig(4)
    rig.write("Torque Enable", 1)
    rig.shaft.load = 0.3
    rig.write("Goal Position", 2348 + 2 * 4096)
    rig.run(4.0)
    held, before = rig.shaft.position[0], rig.read("Present Position")
    rig.bus.write(encode(1, 16, b"\x01DXL\x22"))
    assert rig.bus.read(11, 0.01)[8] == 0
    assert rig.read("Goal Position") == 2348
    assert rig.read("Present Position") == before % 4096 != 2348, "it sags"
    rig.run(2.0)
    assert rig.shaft.position[0] == pytest.approx(held, abs=0.003)


def test_a_higher_gain_gives_way_less() -> None:
    sag = []
    for gain in (400, 1600):
        rig = Rig(3)
        rig.write("Position P Gain", gain)
        rig.write("Torque Enable", 1)
        rig.shaft.load = 0.3
        rig.run(1.0)
        sag.append(2048 - rig.read("Present Position"))
    assert sag[0] == pytest.approx(4 * sag[1], rel=0.2)
    assert sag[1] > 3
    rig.write("Position I Gain", 3000)
    rig.run(3.0)
    assert abs(2048 - rig.read("Present Position")) <= 2  # the integral takes the rest


def test_velocity_profile_is_a_trapezoid() -> None:
    rig = Rig(3)
    rig.write("Profile Velocity", 100)  # 22.9 rpm = 2.40 rad/s
    rig.write("Profile Acceleration", 20)  # 4291.5 rev/min^2 = 7.49 rad/s^2
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 4000)  # 3 rad
    rig.run(0.1)
    assert rig.read("Velocity Trajectory") == pytest.approx(7.49 * 0.1 / RPM, rel=0.1)
    rig.run(0.5)
    assert rig.read("Velocity Trajectory") == 100
    assert rig.read("Present Velocity") == pytest.approx(100, abs=5)
    assert rig.read("Moving Status") & 0x32 == 0x32  # trapezoid, ongoing
    rig.run(0.7)  # 3 rad / 2.40 + 2.40 / 7.49 = 1.57 s in all
    assert abs(rig.read("Position Trajectory") - 4000) > 20
    rig.run(0.5)
    assert rig.read("Position Trajectory") == 4000
    assert abs(rig.read("Present Position") - 4000) <= 8


def test_a_profile_that_never_reaches_its_velocity_is_a_triangle() -> None:
    """x/moving_status: 10 for a triangular, 11 for a trapezoidal, 01 for a rectangular profile."""
    rig = Rig(3)
    rig.write("Profile Velocity", 100)  # 2.40 rad/s, reached after 0.38 rad at 7.49 rad/s^2
    rig.write("Profile Acceleration", 20)
    rig.write("Torque Enable", 1)
    for goal, status in ((2048 + 400, 0x22), (2048, 0x22), (2048 + 600, 0x32), (2048, 0x32)):
        rig.write("Goal Position", goal)
        rig.run(0.1)
        assert rig.read("Moving Status") & 0x32 == status
        rig.run(1.5)
    rig.write("Profile Acceleration", 0)
    rig.write("Goal Position", 2100)
    rig.run(0.005)
    assert rig.read("Moving Status") & 0x32 == 0x12


def test_time_profile_takes_its_time() -> None:
    rig = Rig(3, Drive_Mode=4)
    rig.write("Profile Velocity", 1000)  # ms for the whole move
    rig.write("Profile Acceleration", 250)
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 3000)
    rig.run(0.9)
    assert rig.read("Position Trajectory") < 2990
    rig.run(0.15)
    assert rig.read("Position Trajectory") == 3000


def test_velocity_control_holds_a_speed_and_ramps() -> None:
    rig = Rig(1)
    rig.write("Torque Enable", 1)
    rig.run(0.1)
    assert rig.read("Present Velocity") == 0  # Goal Velocity is 0 at first
    rig.write("Goal Velocity", -80)
    rig.run(1.5)
    assert rig.read("Present Velocity") == pytest.approx(-80, abs=2)
    rig.write("Profile Acceleration", 1)  # 3.58 rpm/s = 15.6 units/s
    rig.write("Goal Velocity", 0)
    rig.run(1.0)
    assert rig.read("Velocity Trajectory") == pytest.approx(-80 + 15.6, abs=1)


def test_pwm_control_is_a_voltage() -> None:
    rig = Rig(16, "XL430-W250")
    rig.write("Goal PWM", 0)
    rig.write("Torque Enable", 1)
    rig.write("Goal PWM", 442)
    rig.run(1.0)
    volt = 442 / 885 * 11.1
    back_emf, resistance = rig.servo.model.back_emf_v_s, rig.servo.model.resistance_ohm
    expected = volt / (back_emf + resistance * 0.03 / 1.78)
    assert rig.shaft.velocity[0] == pytest.approx(expected, rel=0.02)
    assert rig.read("Present PWM") == pytest.approx(442, abs=3)
    assert rig.read("Present Load") == 0


class Rattling(Shaft):
    """A shaft that moves to and fro in the gap of its gears while the rotor keeps turning."""

    rotor_velocity = (1.5,)

    def advance(self, until: float, current: Any) -> None:
        self.velocity[0] = 4.0 * (-1) ** round(1e3 * until)
        self.current[0] = current[0]


def test_a_shaft_that_rattles_in_its_gap_changes_neither_current_nor_measured_voltage() -> None:
    servo = EmulatedServo(load_model("XL430-W250"), 1, registers={"Operating Mode": 16, "Goal PWM": 0})
    bus = FakeBus([servo], Rattling(), clock := VirtualClock())
    for register, value in ((64, b"\1"), (100, (300).to_bytes(2, "little"))):
        bus.write(encode(1, 3, register.to_bytes(2, "little") + value))
        assert bus.read(11, 0.01)[8] == 0
    current = (300 / 885 * servo.supply_v - servo.model.back_emf_v_s * 1.5) / servo.model.resistance_ohm
    for _ in range(20):
        clock.wait_until(clock.now() + 0.0013)
        bus.write(encode(1, 2, b"\x7c\x00\x02\x00"))  # Present PWM
        assert int.from_bytes(bus.read(13, 0.01)[9:11], "little", signed=True) == 300
        assert servo.motor_current_a == pytest.approx(current)


def test_current_based_position_control_is_limited_by_goal_current() -> None:
    rig = Rig(5)
    rig.write("Goal Current", 60)
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 3000)
    rig.run(0.02)
    assert rig.servo.motor_current_a == pytest.approx(60 * 2.69e-3)
    rig.shaft.load = 60 * 2.69e-3 * 1.78 + 0.05  # more than it may push
    rig.run(1.0)
    assert rig.shaft.velocity[0] < 0


def test_extended_position_control_turns_more_than_once() -> None:
    rig = Rig(4)
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 12_000)
    rig.run(4.0)
    assert abs(rig.read("Present Position") - 12_000) <= 6


def test_a_reversed_servo_on_a_reversed_joint_still_arrives() -> None:
    rig = Rig(3, Drive_Mode=1)
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 2500)
    rig.run(1.5)
    assert abs(rig.read("Present Position") - 2500) <= 4
    assert rig.shaft.position[0] < 0


@pytest.mark.parametrize(
    ("mode", "goal", "value"),
    [(1, "Goal Velocity", 50), (3, "Goal Position", 3000), (16, "Goal PWM", 200)],
    ids=["velocity", "position", "PWM"],
)
@pytest.mark.parametrize("drive_mode", [0, 1])
def test_all_that_a_servo_measures_has_the_sign_of_its_goal(mode: int, goal: str, value: int, drive_mode: int) -> None:
    rig = Rig(mode, Drive_Mode=drive_mode)
    rig.write("Profile Velocity", 50)
    rig.write("Torque Enable", 1)
    before = rig.read("Present Position")
    rig.write(goal, value)
    rig.run(0.5)
    assert (rig.shaft.velocity[0] < 0.0) == bool(drive_mode)
    assert rig.read("Present Position") > before
    assert rig.read("Present Velocity") > 5
    assert rig.read("Present PWM") > 0
    if mode != 16:
        assert rig.read("Velocity Trajectory") == pytest.approx(rig.read("Present Velocity"), abs=5)


def test_watchdog_stops_velocity_and_position_control() -> None:
    rig = Rig(1)
    rig.write("Bus Watchdog", 5)
    rig.write("Torque Enable", 1)
    rig.write("Goal Velocity", 80)
    rig.run(1.0)
    assert rig.servo.watchdog_tripped
    assert abs(rig.read("Present Velocity")) <= 1


def test_a_servo_turns_again_once_its_watchdog_has_been_cleared() -> None:
    """The example of the e-Manual's page on the Bus Watchdog, steps 1 to 8."""
    rig = Rig(1)
    rig.write("Torque Enable", 1)
    rig.write("Bus Watchdog", 100)
    rig.run(2.5)
    assert rig.servo.watchdog_tripped
    rig.write("Bus Watchdog", 0)
    rig.write("Goal Velocity", 150)
    rig.run(1.0)
    assert rig.read("Present Velocity") == pytest.approx(150, abs=3)
    assert rig.read("Goal PWM") == 885


@pytest.mark.parametrize("mode", [3, 4, 5])
def test_a_tripped_watchdog_holds_a_joint_in_position_modes(mode: int) -> None:
    rig = Rig(mode)
    rig.write("Bus Watchdog", 5)
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 3000)
    rig.run(3.0)
    assert rig.servo.watchdog_tripped
    held = rig.read("Present Position")
    assert 2048 < held < 2990
    assert abs(held - rig.read("Goal Position")) <= 20
    rig.write("Bus Watchdog", 0)
    rig.write("Goal Position", 2048)
    rig.run(4.0)  # current-based control swings for seconds
    assert abs(rig.read("Present Position") - 2048) <= 6


def test_a_new_goal_current_limits_current_based_position_control_at_once() -> None:
    rig = Rig(5)
    rig.write("Goal Current", 3)
    rig.write("Torque Enable", 1)
    rig.write("Goal Position", 3000)
    rig.run(0.05)
    assert rig.read("Present Current") == 3
    rig.write("Goal Current", 50)
    rig.run(0.05)
    assert rig.read("Present Current") > 10
    rig.write("Goal Current", 2)
    rig.run(0.05)
    assert rig.read("Present Current") <= 2


def test_torque_off_lets_go_at_once() -> None:
    rig = Rig(1)
    rig.write("Torque Enable", 1)
    rig.write("Goal Velocity", 80)
    rig.run(0.5)
    rig.write("Torque Enable", 0)
    assert rig.servo.motor_current_a == 0.0
    assert not rig.servo.needs_ticks


def test_current_mode_is_limited_by_the_supply_if_asked() -> None:
    current = []
    for limited in (False, True):
        servo = EmulatedServo(load_model("XM430-W350"), 1, registers={"Operating Mode": 0}, voltage_limited=limited)
        shaft = Shaft()
        clock = VirtualClock()
        bus = FakeBus([servo], shaft, clock)
        bus.write(encode(1, 3, b"\x40\0\x01") + b"")
        bus.read(11, 0.01)
        clock.wait_until(1.0)
        bus.advance(1.0)
        current.append(servo.motor_current_a)
        assert servo.goal_current_ticks == 1193
    assert current[0] == pytest.approx(1193 * 2.69e-3)
    assert current[1] < 0.3  # near its no-load speed the supply drives hardly any current
    assert shaft.velocity[0] < 12.0 / servo.model.back_emf_v_s


@pytest.mark.parametrize("mode", [0, 1, 3, 4, 5])
@pytest.mark.parametrize("limit", ["PWM Limit", "Goal PWM"])
def test_pwm_limit_and_goal_pwm_limit_every_mode(mode: int, limit: str) -> None:
    model = load_model("XM430-W350")
    servo = EmulatedServo(model, 1, zero_ticks=100, registers={"Operating Mode": mode}, voltage_limited=True)
    shaft = Shaft()
    clock = VirtualClock()
    bus = FakeBus([servo], shaft, clock)
    servo.write(model.registers[limit].address, (100).to_bytes(2, "little"))
    servo.write(64, b"\1")
    goal = {0: (102, 2, 300), 1: (104, 4, 200)}.get(mode, (116, 4, 3900))
    servo.write(goal[0], goal[2].to_bytes(goal[1], "little"))
    fastest = 0.0
    for step in range(1, 1500):
        clock.wait_until(1e-3 * step)
        bus.advance(clock.now())
        fastest = max(fastest, shaft.velocity[0])
    no_load = 100 / 885 * 12.0 / model.back_emf_v_s
    assert 0.5 * no_load < fastest < 1.02 * no_load


def test_where_the_supply_limits_the_current_each_new_goal_counts() -> None:
    servo = EmulatedServo(load_model("XM430-W350"), 1, registers={"Operating Mode": 0}, voltage_limited=True)
    servo.write(64, b"\1")
    for ticks in (100, 150, -40):
        servo.write(102, ticks.to_bytes(2, "little", signed=True))
        servo.tick(1e-3, 0.0, 0.0, 0.0, 0.0)
        assert servo.motor_current_a == pytest.approx(ticks * 2.69e-3)


@pytest.mark.parametrize("goal", [500.0, -37.0, 3.0])
@pytest.mark.parametrize(("fastest", "hardest"), [(2.0, 0.01), (0.5, 0.0), (50.0, 0.3)])
def test_trajectory_reaches_its_goal_within_its_limits(goal: float, fastest: float, hardest: float) -> None:
    trajectory = Trajectory()
    for _ in range(5000):
        before = trajectory.velocity
        trajectory.step(goal, fastest, hardest)
        assert abs(trajectory.velocity) <= fastest + 1e-12
        if hardest:
            assert abs(trajectory.velocity - before) <= hardest + 1e-9
    assert (trajectory.position, trajectory.velocity) == (goal, 0.0)


def test_trajectory_turns_round_for_a_new_goal() -> None:
    trajectory = Trajectory()
    for _ in range(100):
        trajectory.step(1000.0, 2.0, 0.05)
    for _ in range(3000):
        trajectory.step(-100.0, 2.0, 0.05)
    assert trajectory.position == -100.0


def test_profile_without_velocity_is_a_step() -> None:
    assert profile(100.0, 0, 50, False) == (0.0, pytest.approx(50 * 2.4414e-4, rel=1e-3))
    assert profile(100.0, 0, 50, True) == (0.0, 0.0)


@pytest.mark.parametrize("mode", [0, 5])
@pytest.mark.parametrize("limit", ["PWM Limit", "Goal PWM"])
@pytest.mark.parametrize("model", ["XM430-W350", "XL330-M288"])
def test_pwm_limit_and_goal_pwm_limit_the_motor_in_current_modes_too(mode: int, limit: str, model: str) -> None:
    """The manual: PWM Limit holds in every mode, and in modes other than PWM mode, Goal PWM is a limit as well."""
    rig = Rig(mode, model, **({limit: 100} if limit == "PWM Limit" else {}))
    free = Rig(mode, model)
    for each in (rig, free):
        each.write("Torque Enable", 1)
        if limit == "Goal PWM" and each is rig:
            each.write(limit, 100)
        each.write(*(("Goal Current", 300) if mode == 0 else ("Goal Position", 4000)))
        each.run(0.15)
    assert abs(rig.read("Present PWM")) <= 107
    assert abs(rig.shaft.velocity[0]) < 0.5 * abs(free.shaft.velocity[0])


def test_goal_pwm_limits_the_current_also_in_the_moments_after_a_new_goal() -> None:
    """A goal written between two steps of the servo's loop must not drive the motor, or be read back, unlimited."""
    rig = Rig(0)
    rig.write("Goal Current", 0)
    rig.write("Goal PWM", 44)
    rig.write("Torque Enable", 1)
    most = 44 / 885 * 12.0 / rig.servo.model.resistance_ohm
    drawn = []
    for step in range(1, 30):
        rig.write("Goal Current", 300 + step)
        assert abs(rig.servo.motor_current_a) <= 1.01 * most
        rig.run(0.0013)
        drawn.append(rig.shaft.current[0])
        assert abs(rig.read("Present Current")) * 2.69e-3 <= 1.05 * most
    assert 0.5 * most < max(drawn) <= 1.01 * most and min(drawn) >= 0.0
