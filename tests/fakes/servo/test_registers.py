"""The fake's control tables: complete, without overlaps, factory values within their own ranges."""

from itertools import pairwise

import pytest

from hil.fakes.servo.registers import MODEL_NAMES, all_model_names, load_model
from hil.fakes.servo.servo import EmulatedServo


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_registers_do_not_overlap_and_initial_values_are_allowed(name: str) -> None:
    registers = sorted(load_model(name).registers.values(), key=lambda register: register.address)
    for before, after in pairwise(registers):
        assert before.address + before.size <= after.address, f"{before.name} and {after.name}"
    for register in registers:
        if register.writable and register.name != "Secondary(Shadow) ID":
            assert register.minimum <= register.initial <= register.maximum, register.name


def test_xm430_w350_is_the_manuals() -> None:
    model = load_model("XM430-W350")
    assert (model.number, model.current_unit_a) == (1020, 2.69e-3)
    goal = model.registers["Goal Current"]
    assert (goal.address, goal.size, goal.signed, goal.eeprom) == (102, 2, True, False)
    limit = model.registers["Current Limit"]
    assert (limit.address, limit.eeprom, limit.initial, limit.maximum) == (38, True, 1193, 1193)
    assert [model.registers[name].initial for name in ("Baud Rate", "Return Delay Time", "Shutdown")] == [1, 250, 52]
    assert not model.registers["Present Position"].writable


@pytest.mark.parametrize(
    ("name", "number", "current_limit", "velocity_limit", "gains"),
    [
        ("XM430-W210", 1030, 1193, 330, (1920, 100, 0, 0, 800)),
        ("XH430-W350", 1000, 648, 130, (1920, 100, 0, 0, 900)),
        ("XH430-W210", 1010, 648, 210, (1920, 100, 0, 0, 900)),
        ("XW430-T333", 1270, 2047, 139, (1920, 100, 0, 0, 900)),
        ("XM540-W270", 1120, 2047, 128, (1920, 100, 0, 0, 800)),
        ("XM540-W150", 1130, 2047, 230, (1920, 100, 0, 0, 800)),
        ("XH540-W150", 1110, 2047, 300, (1920, 100, 0, 0, 800)),
        ("XW540-T140", 1180, 2047, 304, (1920, 100, 0, 0, 800)),
        ("XL330-M288", 1200, 1750, 445, (1600, 180, 0, 0, 400)),
        ("XL330-M077", 1190, 1750, 1620, (400, 40, 0, 400, 400)),
        ("XC330-T288", 1220, 910, 320, (1200, 40, 0, 0, 900)),
        ("XC330-T181", 1210, 910, 510, (1200, 40, 0, 0, 900)),
        ("XC330-M181", 1230, 2352, 545, (1400, 100, 500, 0, 1200)),
        ("XC330-M288", 1240, 2352, 350, (1600, 50, 500, 0, 1100)),
    ],
)
def test_other_models(name: str, number: int, current_limit: int, velocity_limit: int, gains: tuple[int, ...]) -> None:
    model = load_model(name)
    assert model.number == number
    assert model.registers["Current Limit"].initial == model.registers["Current Limit"].maximum == current_limit
    assert model.registers["Velocity Limit"].initial == velocity_limit
    kinds = ("Velocity I", "Velocity P", "Position D", "Position I", "Position P")
    assert tuple(model.registers[f"{kind} Gain"].initial for kind in kinds) == gains


@pytest.mark.parametrize(
    ("name", "voltage", "velocity_limit", "position_p", "moving"),
    [("XC430-W150", (60, 160), 460, 460, 20), ("XC430-W240", (60, 160), 306, 700, 10)],
)
def test_models_without_current_sensor(
    name: str, voltage: tuple[int, int], velocity_limit: int, position_p: int, moving: int
) -> None:
    registers = load_model(name).registers
    assert (registers["Min Voltage Limit"].initial, registers["Max Voltage Limit"].initial) == voltage
    wanted = {"Velocity Limit": velocity_limit, "Position P Gain": position_p, "Moving Threshold": moving}
    assert {each: registers[each].initial for each in wanted} == wanted
    assert "Current Limit" not in registers


def test_xl430_has_no_current() -> None:
    model = load_model("XL430-W250")
    assert "Goal Current" not in model.registers
    assert 0 not in model.operating_modes


@pytest.mark.parametrize("name", [name for name in all_model_names() if name not in MODEL_NAMES and name != "XL320"])
def test_no_model_obeys_another_id_from_the_factory(name: str) -> None:
    servo = EmulatedServo(load_model(name), 5)
    assert servo.shadow_id is None
    (shadow,) = [each for each in servo.memory.registers if each.startswith("Secondary")]
    assert servo.value(shadow) == 255


@pytest.mark.parametrize(("name", "limits"), [("2XL430-W250", (72, 140, 60, 250)), ("2XC430-W250", (80, 160, 60, 275))])
def test_factory_values_of_the_double_servos(name: str, limits: tuple[int, ...]) -> None:
    registers = load_model(name).registers
    kinds = ("Temperature Limit", "Max Voltage Limit", "Min Voltage Limit", "Velocity Limit")
    assert tuple(registers[kind].initial for kind in kinds) == limits
    common = ("Operating Mode", "Protocol Type", "Moving Threshold", "PWM Limit", "Max Position Limit", "Shutdown")
    assert tuple(registers[kind].initial for kind in common) == (3, 2, 10, 885, 4095, 52)


def test_unknown_model() -> None:
    with pytest.raises(KeyError):
        load_model("XM430-W351")
