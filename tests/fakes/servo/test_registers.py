"""The fake's control tables: complete, without overlaps, factory values within their own ranges."""

from itertools import pairwise

import pytest

from hil.fakes.servo.registers import MODEL_NAMES, load_model


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
    ("name", "number", "current_limit"),
    [
        ("XM430-W210", 1030, 1193),
        ("XH430-W350", 1000, 648),
        ("XM540-W270", 1120, 2047),
        ("XL330-M288", 1200, 1750),
        ("XC330-T288", 1220, 910),
    ],
)
def test_other_models(name: str, number: int, current_limit: int) -> None:
    model = load_model(name)
    assert model.number == number
    assert model.registers["Current Limit"].initial == current_limit


def test_xl430_has_no_current() -> None:
    model = load_model("XL430-W250")
    assert "Goal Current" not in model.registers
    assert 0 not in model.operating_modes


def test_unknown_model() -> None:
    with pytest.raises(KeyError):
        load_model("XM430-W351")
