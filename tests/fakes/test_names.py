"""Arms by name, wherever an arm can be given."""

import json
import sys
from pathlib import Path

import pytest
import serial

from hil import fakes
from hil.config.bundled import bundled_configs
from hil.config.schema import load_config, port_url
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import DescriptionError, load_fake, make_bus
from hil.fakes.names import arm_names, find_arm
from hil.setup.session.servo_session import servo_session
from tests.support.command_line import hil

READY = {
    "koch": {1: "XL430-W250", 2: "XL430-W250"} | dict.fromkeys(range(3, 7), "XL330-M288"),
    "viperx_300": dict.fromkeys(range(1, 8), "XM540-W270") | {8: "XM430-W350", 9: "XM430-W350"},
    "open_manipulator_x": dict.fromkeys(range(11, 16), "XM430-W350"),
}


@pytest.mark.parametrize("name", READY)
def test_ready_arms_rest_where_they_are(name: str) -> None:
    clock = VirtualClock()
    bus = make_bus(load_fake(name), clock)
    assert {servo_id: servo.model.name for servo_id, servo in bus.servos.items()} == READY[name]
    before = list(bus.plant.position)
    clock.wait_until(2.0)
    assert all(servo.hardware_error == 0 and not servo.torque_enabled for servo in bus.servos.values())
    assert bus.plant.position == pytest.approx(before, abs=0.05)


def test_shadows_of_the_viperx_listen_to_their_leaders() -> None:
    servos = make_bus(load_fake("viperx_300"), VirtualClock()).servos
    assert {servo_id: servo.shadow_id for servo_id, servo in servos.items() if servo.shadow_id} == {3: 2, 5: 4}


@pytest.mark.parametrize("name", arm_names())
def test_a_name_is_a_url_a_port_and_an_arm_anywhere(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.chdir(tmp_path)
    fakes.register()
    with serial.serial_for_url(f"fake://{name}", 1_000_000, timeout=0.1) as port:
        ids, baud = list(port.bus.servos), next(iter(port.bus.servos.values())).baud
    assert Path(port_url(name).removeprefix("fake://")).is_file()
    assert hil("fake", name) == 0 and f"ID {ids[0]}:" in capsys.readouterr().out
    for given in (name, f"fake://{name}"):
        assert hil("scan", given, "--baud", str(baud), "--json") == 0
        assert [servo["id"] for servo in json.loads(capsys.readouterr().out)["servos"]] == ids


@pytest.mark.parametrize("name", sorted({*arm_names()} & {*bundled_configs()} - {*READY}))
def test_a_bundled_fake_arm_is_opened_by_its_configurations_name(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    config = load_config(Path(name))
    with servo_session(config) as bus:
        assert len(bus.joints) == len(config.joints)


def test_a_file_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_arm("koch").is_file()
    Path("koch").write_text("", encoding="utf-8")
    assert find_arm("koch") == Path("koch")
    assert find_arm("/dev/ttyUSB0") == Path("/dev/ttyUSB0")
    assert port_url("/dev/ttyUSB0") == "/dev/ttyUSB0"
    assert port_url("socket://bench:4000") == "socket://bench:4000"


def test_unknown_names_come_with_the_known_ones() -> None:
    with pytest.raises(DescriptionError, match=r"known by name: .*koch, .*open_manipulator_x, .*viperx_300"):
        load_fake("nosuch")


@pytest.mark.parametrize("name", ["fake_two_link", "koch"])
def test_commands_take_names(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", sys.argv)
    assert hil("fake", name) == 0
    assert "ID 1:" in capsys.readouterr().out
    assert hil("scan", name, "--baud", "1000000", "--json") == 0
    assert '"id": 1' in capsys.readouterr().out
    assert hil("setup", name, "--id", "1", "--return-delay-us", "20", "--yes") == 0
    assert "Return Delay Time" in capsys.readouterr().out
    if name == "fake_two_link":
        made = tmp_path / "arm.toml"
        assert hil("init", name, "--baud", "1000000", "--yes", "--out", made) == 0
        assert load_config(made).port.url.startswith("fake://")
