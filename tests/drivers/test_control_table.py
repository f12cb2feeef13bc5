"""Control tables read from the SDK's own files."""

import pytest

from drivers.control_table import load_control_table, model_names
from drivers.errors import UnknownModel
from drivers.servo_model import CURRENT_MODELS, servo_model


def test_registers_of_the_xm430_stand_where_the_manual_has_them() -> None:
    table = load_control_table("XM430-W350")
    assert table.number == 1020
    places = {name: (table[name].address, table[name].size) for name in ("Goal Current", "Present Position", "ID")}
    assert places == {"Goal Current": (102, 2), "Present Position": (132, 4), "ID": (7, 1)}


@pytest.mark.parametrize("model", sorted(model_names().values()))
def test_every_table_loads_and_has_an_id(model: str) -> None:
    table = load_control_table(model)
    assert table["ID"].size == 1
    assert model_names()[table.number] == model


def test_signed_registers_round_trip_negative_values() -> None:
    register = load_control_table("XM430-W350")["Goal Current"]
    assert register.encode(-2) == b"\xfe\xff"
    assert register.decode(b"\xfe\xff") == -2


def test_unsigned_registers_do_not_go_negative() -> None:
    register = load_control_table("XM430-W350")["Current Limit"]
    assert register.decode(b"\xff\xff") == 65535
    with pytest.raises(OverflowError):
        register.encode(-1)


def test_unknown_model_lists_the_known_ones() -> None:
    with pytest.raises(UnknownModel, match=r"XM430-W351.*Known: .*XM430-W350"):
        load_control_table("XM430-W351")


def test_a_model_without_current_mode_is_not_offered() -> None:
    with pytest.raises(UnknownModel, match="XL430-W250"):
        servo_model("XL430-W250")


@pytest.mark.parametrize("model", sorted(CURRENT_MODELS))
def test_every_current_model_has_the_registers_of_the_exchange_together(model: str) -> None:
    table = load_control_table(model)
    current, velocity, position = (table[f"Present {name}"] for name in ("Current", "Velocity", "Position"))
    assert current.address + current.size == velocity.address
    assert velocity.address + velocity.size == position.address
    assert "Goal Current" in table
    assert "Bus Watchdog" in table
