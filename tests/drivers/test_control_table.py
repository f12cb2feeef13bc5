"""Control tables read from the SDK's own files."""

import itertools
from importlib.machinery import ModuleSpec
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from hil.cli.errors import exit_code
from hil.drivers import control_table
from hil.drivers.control_table import load_control_table, model_names
from hil.drivers.errors import NoControlTables, UnknownModel
from hil.drivers.servo_model import SERVO_MODELS, Mode, servo_model
from hil.drivers.state import read_back_spans, spans
from hil.drivers.sync_read import one_each


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


@pytest.mark.parametrize(
    ("installed", "said"),
    [
        ("3.8.4", r"version 4\.1 or newer, but 3\.8\.4 is installed, probably because another package needs an older"),
        (None, r"version 4\.1 or newer, which is not installed"),
    ],
)
@pytest.mark.parametrize("without", ["package", "tables"])
def test_an_sdk_without_control_tables_is_an_error_of_the_installation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: str | None, said: str, without: str
) -> None:
    def installed_version(package: str) -> str:
        if installed is None:
            raise PackageNotFoundError(package)
        return installed

    empty = ModuleSpec("dynamixel_easy_sdk", None, origin=str(tmp_path / "__init__.py"))
    monkeypatch.setattr(control_table, "find_spec", lambda _: None if without == "package" else empty)
    monkeypatch.setattr(control_table, "version", installed_version)
    model_names.cache_clear()
    with pytest.raises(NoControlTables, match=said) as caught:
        model_names()
    assert exit_code(caught.value) == 2


def test_an_unknown_servo_model_lists_what_is_possible() -> None:
    with pytest.raises(UnknownModel, match=r"AX-12.*XM430-W350"):
        servo_model("AX-12")


@pytest.mark.parametrize("model", sorted(SERVO_MODELS))
def test_every_model_has_the_registers_of_the_exchange_together(model: str) -> None:
    table = load_control_table(model)
    pwm = servo_model(model).default_mode is Mode.PWM
    velocity, position = table["Present Velocity"], table["Present Position"]
    drive = table["Present PWM" if pwm else "Present Current"]
    # Under PWM the two bytes of Present Load lie between.
    assert drive.address + drive.size == velocity.address - (2 if pwm else 0)
    assert velocity.address + velocity.size == position.address
    assert ("Goal PWM" if pwm else "Goal Current") in table
    assert "Bus Watchdog" in table


def test_servos_of_any_models_and_modes_can_be_read_together() -> None:
    """A servo refuses a read that ends at an undefined address, as where the XL430-W250 lacks Goal Current."""
    tables = [load_control_table(model) for model in sorted(SERVO_MODELS)]
    driven = [(each, mode) for each in tables for mode in Mode if mode is Mode.PWM or "Goal Current" in each]
    for two in itertools.combinations(driven, 2):
        both, modes = zip(*two, strict=True)
        for one in (*spans(modes, both), *read_back_spans(modes, both)):
            shared = one_each(one, 2)[0]
            ends = shared.address, shared.address + shared.size - 1
            assert all(table.defines(end) for table in both for end in ends)


@pytest.mark.parametrize("model", sorted(SERVO_MODELS))
def test_published_torque_constants_have_a_spread_around_them(model: str) -> None:
    for published in (servo_model(model).torque_per_ampere, servo_model(model).torque_per_volt):
        assert published.low <= published.value <= published.high
        assert published.low < published.high


def test_torque_constants_are_the_manuals() -> None:
    assert servo_model("XM430-W350").torque_per_ampere.low == pytest.approx(4.8 / 2.7)
    assert servo_model("XM430-W350").torque_per_ampere.high == pytest.approx(2.48, abs=0.01)
    assert servo_model("XL330-M288").torque_per_ampere.value == pytest.approx(0.354, abs=1e-3)
    assert servo_model("XL430-W250").torque_per_volt.value == pytest.approx(0.125, abs=1e-3)
