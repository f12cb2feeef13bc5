"""The [fake] table: valid tables are read as written, and invalid ones yield an error message."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from hil.drivers.packet import Instruction, encode, encode_status
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.description import DescriptionError, FakeArm, load_fake, make_bus
from tests.support.paths import CONFIGS

CONFIG = CONFIGS / "fake_two_link.toml"


def edited(tmp_path: Path, old: str, new: str) -> Path:
    text = CONFIG.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "arm.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return path


FIRST = '[[fake.servos]]\nid = 1\nmodel = "XM430-W350"\nzero_ticks = 3072\n'


def test_the_shipped_arm() -> None:
    fake = load_fake(CONFIG)
    assert (fake.seed, fake.adapter_latency_us) == (1, 60.0)
    assert [(servo.id, servo.model, servo.zero_ticks, servo.baud) for servo in fake.servos] == [
        (1, "XM430-W350", 3072, 1_000_000),
        (2, "XM430-W350", 2048, 1_000_000),
    ]
    assert len(fake.arm.drives) == 2


def test_bus_as_described(tmp_path: Path) -> None:
    path = edited(
        tmp_path,
        FIRST,
        FIRST + "direction = -1\nfirmware = 46\nbaud = 57_600\nreturn_delay_us = 500\ninput_voltage_v = 11.1\n"
        'temperature_c = 40\nregisters = { "Drive Mode" = 1, "Current Limit" = 600 }\n',
    )
    servo = make_bus(load_fake(path), VirtualClock()).servos[1]
    assert (servo.direction, servo.firmware, servo.baud, servo.return_delay_s) == (-1, 46, 57_600, 500e-6)
    assert [servo.value(name) for name in ("Drive Mode", "Current Limit", "Baud Rate", "Return Delay Time")] == [
        1,
        600,
        1,
        250,
    ]
    assert [servo.value(name) for name in ("Present Input Voltage", "Present Temperature")] == [111, 40]
    assert servo.hardware_error == 0


def test_servos_may_have_the_same_id(tmp_path: Path) -> None:
    bus = make_bus(load_fake(edited(tmp_path, FIRST, FIRST.replace("id = 1", "id = 2"))), VirtualClock())
    bus.write(encode(2, Instruction.PING))
    assert bus.read(100, 1.0) == encode_status(2, 0, b"\xfc\x03\x30")
    assert bus.collisions == 1


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "adapter_latency_us = 60.0",
            "adapter_latency_us = -1.0",
            ["fake.adapter_latency_us = -1.0", "must be at least 0"],
        ),
        (
            "adapter_latency_us",
            "adapter_latency",
            ["fake.adapter_latency is not a known key", "did you mean adapter_latency_us?"],
        ),
        (FIRST, FIRST + "baud = 9601\n", ["fake.servos[1].baud = 9601", "57600", "are allowed"]),
        (FIRST, FIRST + "direction = 0\n", ["fake.servos[1].direction = 0", "1 or -1 is allowed"]),
        (FIRST, FIRST + "return_delay_us = 7\n", ["fake.servos[1].return_delay_us = 7", "multiple of 2"]),
        (FIRST, FIRST.replace("3072", "10_000_000"), ["fake.servos[1].zero_ticks = 10000000", "at most 1048576"]),
        (FIRST, FIRST.replace("W350", "W351"), ["fake.servos[1].model = 'XM430-W351'", "did you mean XM430-W350?"]),
        (FIRST, FIRST.replace("XM430-W350", "motor"), ["fake.servos[1].model = 'motor'", "XM430-W350, XM430-W210"]),
        (FIRST, FIRST.replace("id = 1", "id = 253"), ["fake.servos[1].id = 253", "252"]),
        (FIRST, "", ["1 servos for 2 drives"]),
        (FIRST, FIRST + 'registers = { "Goal Current" = 1 }\n', ["Goal Current", "not a settable EEPROM register"]),
        (FIRST, FIRST + 'registers = { "Shutdown" = 256 }\n', ["Shutdown", "0 to 255 is allowed"]),
        (FIRST, FIRST + 'registers = { "ID" = 7 }\n', ['fake.servos[1]: registers: "ID" = 7', "the key id sets it"]),
        (FIRST, FIRST + 'registers = { "Baud Rate" = 1 }\n', ['"Baud Rate" = 1', "the key baud sets it"]),
        (FIRST, FIRST + 'registers = { "Return Delay Time" = 1 }\n', ["the key return_delay_us sets it"]),
        (
            FIRST,
            FIRST + 'registers = { "Operating Mode" = 2 }\n',
            ['"Operating Mode" = 2', "0, 1, 3, 4, 5 or 16 is allowed for the XM430-W350"],
        ),
        (
            FIRST,
            FIRST.replace("XM430-W350", "XL430-W250") + 'registers = { "Operating Mode" = 0 }\n',
            ['"Operating Mode" = 0', "1, 3, 4 or 16 is allowed for the XL430-W250"],
        ),
        (
            FIRST,
            FIRST.replace("XM430-W350", "XL330-M288") + "baud = 4_500_000\n",
            ["fake.servos[1]: baud = 4500000", "at most 4000000 is allowed for the XL330-M288"],
        ),
        ("gear_ratio = 353.5", "gear_ratio = 0.0", ["fake.arm.drives[1].gear_ratio = 0.0", "greater than 0"]),
    ],
)
def test_errors_name_file_key_value_and_what_is_allowed(tmp_path: Path, old: str, new: str, said: list[str]) -> None:
    path = edited(tmp_path, old, new)
    with pytest.raises(DescriptionError) as caught:
        load_fake(path)
    for part in [str(path), *said]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"[port]\n", "no [fake] table"),
        (b"fake = 3\n", "no [fake] table"),
        (b"[fake", "not valid TOML"),
        (b"\xff", "read"),
    ],
)
def test_files_that_are_no_description(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "arm.toml"
    path.write_bytes(content)
    with pytest.raises(DescriptionError, match=said.replace("[", r"\[")):
        load_fake(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DescriptionError, match=r"nowhere\.toml cannot be read: No such file"):
        load_fake(tmp_path / "nowhere.toml")


def test_descriptions_are_frozen() -> None:
    fake = load_fake(CONFIG)
    with pytest.raises(ValidationError):
        fake.seed = 2
    assert isinstance(fake, FakeArm)
