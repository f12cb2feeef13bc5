"""--take-over: what it lowers is on file first, and an arm that is half let down is let down completely later."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from hil.config.schema import Config
from hil.drivers.errors import BusShared, NoReply, TorqueHeld
from hil.drivers.servo import Servo
from hil.drivers.torque import held
from hil.setup.finding import Level
from hil.setup.preflight import check_arm
from hil.setup.session import settings_file
from hil.setup.session.servo_session import lay_at_start, servo_session
from hil.setup.unmoved import MOST_RAD, where_it_lies
from tests.support.bench import SHORT, Arm, Bench
from tests.support.command_line import hil

GOAL_PWM = 600
SERVO_1, SERVO_2 = (f"[[fake.servos]]\nid = {each}\n" for each in (1, 2))


def taking_over(config: Config) -> Config:
    return config.model_copy(update={"safety": config.safety.model_copy(update={"take_over": True})})


def hold(port: Any) -> None:
    for servo in port.bus.servos.values():
        servo.write(100, GOAL_PWM.to_bytes(2, "little"))
        servo.write(64, b"\x01")


def raised(port: Any, mode: int = 3) -> None:
    """Hold the arm straight out: by position control, or by a current or PWM that balances it."""
    port.bus.plant._state = (0.0,) * 8
    hold(port)
    for servo, current, pwm in zip(port.bus.servos.values(), (160, 34), (170, 40), strict=True):
        if mode != 3:
            servo.write(64, b"\x00")
            servo.write(11, bytes((mode,)))
            servo.write(102, current.to_bytes(2, "little"))
            servo.write(100, (pwm if mode == 16 else GOAL_PWM).to_bytes(2, "little"))
            servo.write(64, b"\x01")


@contextmanager
def stopping_at(monkeypatch: pytest.MonkeyPatch, write_number: int) -> Iterator[None]:
    """Raise KeyboardInterrupt at a write of Goal PWM."""
    number = iter(range(1, write_number))

    def stopping(servo: Servo, register: str, value: int, attempts: int | None = None) -> None:
        if register == "Goal PWM" and next(number, None) is None:
            raise KeyboardInterrupt
        write(servo, register, value, attempts)

    write = Servo.write
    with monkeypatch.context() as patch:
        patch.setattr(Servo, "write", stopping)
        yield


def on_file() -> list[str]:
    return [each.name for each in settings_file.state_folder().glob("*.json")]


def test_the_original_goals_are_on_file_before_the_first_is_lowered(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the program is killed then, nothing else says what they were."""
    bench.prepare = hold
    config = taking_over(arm(SHORT))
    seen: list[int] = []
    write = Servo.write

    def watched(servo: Servo, register: str, value: int, attempts: int | None = None) -> None:
        if register == "Goal PWM":
            kept = settings_file.load(servo.port.url, servo.id, servo.table.model)
            assert kept is not None
            seen.append(kept.settings["Goal PWM"])
        write(servo, register, value, attempts)

    monkeypatch.setattr(Servo, "write", watched)
    with servo_session(config):
        pass
    assert seen and set(seen) == {GOAL_PWM}
    assert bench.changed() == ["Torque Enable of 1: 1 -> 0", "Torque Enable of 2: 1 -> 0"] and on_file() == []


def test_a_second_take_over_does_not_take_lowered_goals_for_the_original_ones(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.prepare = hold
    config = taking_over(arm(SHORT))
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt) as stopped, stopping_at(monkeypatch, 12), servo_session(config):
            pass
        said = "\n".join(stopped.value.__notes__)
        assert f"Goal PWM of ID 2, originally {GOAL_PWM}" in said and "--take-over" in said
        assert "an earlier run left" not in said and "TORQUE IS ON" in said
        assert all(servo.torque_enabled and servo.value("Goal PWM") < GOAL_PWM for servo in bench.servos.values())
        assert len(on_file()) == 2
    with servo_session(config):
        pass
    assert all(servo.value("Goal PWM") == GOAL_PWM for servo in bench.servos.values()) and on_file() == []


def half_let_down(config: Config, bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.prepare = hold
    with (
        pytest.raises(KeyboardInterrupt),
        stopping_at(monkeypatch, 12),
        servo_session(taking_over(config)),
    ):
        pass


def test_a_check_of_an_arm_that_is_half_let_down_leaves_it_and_says_so(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = arm(SHORT)
    half_let_down(config, bench, monkeypatch)
    before = bench.changed()
    found = [each for each in check_arm(config) if each.level is not Level.OK]
    assert bench.changed() == before and len(on_file()) == 2
    (torque, _) = [each for each in found if each.what == "torque"]
    assert torque.fix.endswith("--take-over") and "Another program" not in torque.fix
    left = [each.fix for each in found if each.what == "settings from an earlier run"]
    assert len(left) == 2 and f"was {GOAL_PWM}" in left[0] and "--take-over" in left[0]
    with pytest.raises(TorqueHeld), servo_session(config):
        pass
    assert bench.changed() == before and len(on_file()) == 2


def test_once_its_torque_is_off_a_check_restores_an_arm_that_was_half_let_down(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = arm(SHORT)
    half_let_down(config, bench, monkeypatch)
    for servo in bench.servos.values():
        servo.write(64, b"\x00")
        servo.write(112, (60).to_bytes(4, "little"))  # Profile Velocity, which the take-over had not changed
    assert sum(f"-> {GOAL_PWM}" in each.found for each in check_arm(config)) == 2
    assert all(servo.value("Profile Velocity") == 60 for servo in bench.servos.values())
    assert all(servo.value("Goal PWM") == GOAL_PWM for servo in bench.servos.values()) and on_file() == []


@pytest.mark.parametrize(("pilot", "again"), [(False, "record"), (True, "identify")])
def test_scan_and_check_name_the_command_that_lets_a_half_let_down_arm_down(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pilot: bool, again: str
) -> None:
    lengths = ("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.18]\n")
    config = arm(SHORT, lengths, ("[experiment]\n", f"[experiment]\npilot = {str(pilot).lower()}\n"))
    half_let_down(config, bench, monkeypatch)
    for command in (("scan", config.url, "--baud", 1_000_000), ("check", config.path)):
        capsys.readouterr()
        hil(*command)
        assert capsys.readouterr().out.splitlines()[-1] == f"Next: hil {again} {config.path} --take-over"


def test_a_take_over_that_is_stopped_before_it_lowers_anything_leaves_nothing(arm: Arm, bench: Bench) -> None:
    def interrupted(_: str) -> None:
        raise KeyboardInterrupt

    bench.prepare = hold
    with (
        pytest.raises(KeyboardInterrupt) as stopped,
        servo_session(taking_over(arm(SHORT)), say=interrupted),
    ):
        pass
    assert bench.changed() == [] and on_file() == []
    assert "originally" not in "".join(stopped.value.__notes__)


def test_servos_whose_watchdog_has_tripped_are_let_down_too(arm: Arm, bench: Bench) -> None:
    """As after a program with a watchdog was killed; a tripped watchdog locks the goals."""

    def tripped(port: Any) -> None:
        hold(port)
        for servo in port.bus.servos.values():
            servo.memory.set("Bus Watchdog", 0xFF)

    bench.prepare = tripped
    with servo_session(taking_over(arm(SHORT))):
        assert not any(servo.torque_enabled for servo in bench.servos.values())
    assert all(servo.value("Goal PWM") == GOAL_PWM for servo in bench.servos.values())


@pytest.mark.parametrize("every_s", [0.02, 0.1, 0.5])
def test_another_program_that_raises_the_lowered_goals_is_named_and_torque_cut(
    arm: Arm, bench: Bench, every_s: float
) -> None:
    bench.prepare = raised
    next_at = [0.0]
    with pytest.raises(BusShared, match="another program is driving the arm") as ended:
        bench_open = servo_session(taking_over(arm(SHORT)))
        with rewriting(bench, every_s, next_at), bench_open:
            pass
    assert "Goal PWM" in str(ended.value) and "Torque is off on all servos" in "".join(ended.value.__notes__)
    assert not any(servo.torque_enabled for servo in bench.servos.values())


@contextmanager
def rewriting(bench: Bench, every_s: float, next_at: list[float]) -> Iterator[None]:
    """Let another program write the servos' goals regularly."""

    def interfere(port: Any) -> None:
        raised(port)
        write: Callable[[bytes], int] = port.write

        def watched(data: bytes) -> int:
            if (now := port.clock.now()) >= next_at[0]:
                next_at[0] = now + every_s
                for servo in port.bus.servos.values():
                    servo.write(100, GOAL_PWM.to_bytes(2, "little"))
            return write(data)

        port.write = watched

    bench.prepare = interfere
    yield


@pytest.mark.parametrize("mode", [0, 3, 16])
def test_an_arm_that_sinks_for_longer_than_a_few_seconds_is_not_cut_in_mid_air(
    arm: Arm, bench: Bench, mode: int
) -> None:
    """Its motors brake it, in current mode as well if Goal PWM limits them."""
    seen: list[tuple[float, bool]] = []

    def watched(port: Any) -> None:
        raised(port, mode)
        plant, shoulder = port.bus.plant, port.bus.servos[1]
        advance = plant.advance

        def noting(until: float, current: Any) -> None:
            advance(until, current)
            seen.append((max(map(abs, plant.velocity)), shoulder.torque_enabled))

        plant.advance = noting

    bench.prepare = watched
    limited = [(each, f"{each}voltage_limited = true\n") for each in (SERVO_1, SERVO_2)]
    with servo_session(taking_over(arm(SHORT, *limited))) as bus:
        angles = bus.read_positions()
    cut = next(index for index, (_, is_on) in enumerate(seen) if not is_on)
    assert max(speed for speed, _ in seen) < 1.0 and seen[cut][0] < 0.02
    assert abs(angles[0] + 1.57) < 0.3


def test_an_arm_that_still_sinks_when_its_torque_is_cut_is_first_read_at_rest(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.prepare = raised
    monkeypatch.setattr(held, "SINKING_S", 0.3)
    with servo_session(taking_over(arm(SHORT))) as bus:
        first, now = lay_at_start(), where_it_lies(bus)
    assert all(abs(now[drive] - first[drive]) * abs(drive.position_unit) < MOST_RAD for drive in now)
    assert "Joint 'shoulder' (ID 1, XM430-W350)" in capsys.readouterr().err


@pytest.mark.parametrize("off_upright", [0.1, 0.15, 0.2, 0.25, 0.3])
def test_a_joint_that_creeps_under_its_brake_is_not_at_rest(arm: Arm, bench: Bench, off_upright: float) -> None:
    """Near its upright pose, gravity hardly exceeds friction, and only the brake keeps the arm from falling."""
    at_cut: list[float] = []

    def prepared(port: Any) -> None:
        plant, servo = port.bus.plant, port.bus.servos[1]
        plant._state = (1.57 - off_upright, *(0.0,) * 7)
        hold(port)
        write = servo.write

        def noting(address: int, data: bytes) -> Any:
            if address == 64 and data == b"\x00" and not at_cut:
                at_cut.append(max(map(abs, plant.velocity)))
            return write(address, data)

        servo.write = noting

    bench.prepare = prepared
    limited = [(each, f"{each}voltage_limited = true\n") for each in (SERVO_1, SERVO_2)]
    with servo_session(taking_over(arm(SHORT, *limited))):
        pass
    assert at_cut[0] < 0.008, "3 ticks a second, and their rounding"


def test_a_servo_that_does_not_answer_does_not_hide_the_torque_of_the_others(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.prepare = hold
    read = Servo.read

    def one_silent(servo: Servo, register: str, attempts: int = 3) -> int:
        if servo.id == 1 and servo.read_despite_error("Goal PWM") < GOAL_PWM:
            raise NoReply(f"{servo.title} does not answer.")
        return read(servo, register, attempts)

    monkeypatch.setattr(Servo, "read", one_silent)
    with pytest.raises(NoReply) as ended, servo_session(taking_over(arm(SHORT))):
        pass
    said = "\n".join(ended.value.__notes__)
    assert "TORQUE IS ON at Joint 'elbow'" in said and "could not read whether it is off at Joint 'shoulder'" in said
