"""Before a run: a check leaves every register as it was; held arms and servos of others are left alone."""

from pathlib import Path
from typing import Any

import pytest

from hil.config.schema import Config, load_config
from hil.drivers.bus import ServoBus
from hil.drivers.errors import TorqueHeld, WrongSetting
from hil.drivers.servo import Servo
from hil.setup.finding import Finding, Level
from hil.setup.preflight import check_arm
from hil.setup.session.servo_session import servo_session
from tests.support.bench import SHORT, Arm, Bench, play

SERVO_2 = 'id = 2\nmodel = "XM430-W350"\nzero_ticks = 2048\n'


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
    assert all(servo.value("Goal PWM") == 885 for servo in bench.servos.values()), "as it was before"


def test_a_stop_while_the_arm_sinks_tells_what_was_lowered(
    arm: Arm, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Restoring the goals with torque on would jerk the arm up."""
    bench.prepare = hold
    config = arm(SHORT)
    taken = config.model_copy(update={"safety": config.safety.model_copy(update={"take_over": True})})
    steps = iter(range(10))

    def stopping(servo: Servo, register: str, value: int, attempts: int | None = None) -> None:
        if register == "Goal PWM" and next(steps, None) is None:
            raise KeyboardInterrupt
        write(servo, register, value, attempts)

    write = Servo.write
    monkeypatch.setattr(Servo, "write", stopping)
    with pytest.raises(KeyboardInterrupt) as stopped, servo_session(taken):
        pass
    said = "\n".join(stopped.value.__notes__)
    assert "TORQUE IS ON" in said
    assert "lowered: Goal PWM of ID 1, originally 885, Goal PWM of ID 2, originally 885." in said
    assert all(0 < servo.value("Goal PWM") < 885 and servo.torque_enabled for servo in bench.servos.values())


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


SHADOW = SERVO_2.replace("id = 2", "id = 3") + 'joint = 2\nregisters = { "Secondary(Shadow) ID" = 2 }\n'


def test_a_servo_outside_the_arm_that_obeys_commands_to_it_is_refused(arm: Arm, tmp_path: Path, bench: Bench) -> None:
    """As on a ViperX whose shadow servo is not in the configuration."""
    config = arm(SHORT, ("[fake.arm]", f"[[fake.servos]]\n{SHADOW}[fake.arm]"))
    (stop,) = [finding for finding in stops(config) if "other servos" in finding.what]
    assert "--id 3 --secondary-id 255" in stop.fix
    with pytest.raises(WrongSetting, match=r"ID 3.*obeys torque and goal commands for joint 'elbow' \(ID 2"):
        play(config, tmp_path / "run")
    assert not bench.servos[3].torque_enabled and bench.changed() == []
