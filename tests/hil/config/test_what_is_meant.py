"""Wrong files: the message quotes the line or the value, and says what to write instead."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.config.fake_url import url_for, url_from
from hil.config.schema import load_config
from hil.drivers.bus import ServoBus
from hil.errors import ConfigError
from tests.support.command_line import hil

ArmFile = Callable[..., Path]


@pytest.mark.parametrize(
    ("line", "cause"),
    [
        ("rate = 200 Hz", "without its unit"),
        ("rate = 4,0", "a point, not a comma"),
        ("pilot = True", "lower case"),
        ("limit = [-90\u00b0, 90\u00b0]", "in rad"),
        ("turn = 90\u00b0  # a quarter", "in rad"),
        ("model = XM430-W350", "needs quotes"),
        ("rate =", "missing"),
        ("rate: 200", "= between"),
        ("pilot = yes", "true or false"),
    ],
)
def test_a_syntax_error_quotes_the_line_and_names_the_cause(tmp_path: Path, line: str, cause: str) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(f"[experiment]\n{line}\nseed = 1\n", encoding="utf-8")
    with pytest.raises(ConfigError) as raised:
        load_config(path)
    message = str(raised.value).splitlines()
    assert message[1].strip() == line and cause in message[2]


def test_a_syntax_error_of_another_kind_claims_no_cause(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text('[experiment]\nname = "a" "b"\n', encoding="utf-8")
    with pytest.raises(ConfigError) as raised:
        load_config(path)
    assert str(raised.value).splitlines()[1:] == ['  name = "a" "b"']


@pytest.mark.parametrize("given", ["xm430 w350", "XM430W350", "Xm430-W350-T"])
def test_a_model_that_is_nearly_right_is_recognised(arm_file: ArmFile, given: str) -> None:
    path = arm_file()
    path.write_text(path.read_text(encoding="utf-8").replace("XM430-W350", given), encoding="utf-8")
    with pytest.raises(ConfigError, match="did you mean XM430-W350") as raised:
        load_config(path)
    assert "XL330" not in str(raised.value)


def test_a_number_in_place_of_a_list_is_written_out_for_each_joint(arm_file: ArmFile) -> None:
    path = arm_file()
    text = path.read_text(encoding="utf-8")
    old = next(line for line in text.splitlines() if line.startswith("peak_torque"))
    path.write_text(text.replace(old, "peak_torque = 0.5"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"one entry for each joint: \[0\.5, 0\.5\]"):
        load_config(path)


def test_formats_in_one_word_are_told_apart(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("export", identified, "--format", "urdf,mjcf") == 2
    assert "--format urdf --format mjcf" in capsys.readouterr().err


def test_a_fake_arms_path_is_relative_to_the_file_that_names_it(
    arm_file: ArmFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = arm_file()
    mine = tmp_path / "mine" / "arm.toml"
    mine.parent.mkdir()
    url = url_for(f"fake://{arm.absolute()}", mine)
    assert url == f"fake://{arm.absolute()}", "an absolute path stays"
    monkeypatch.chdir(arm.parent)
    url = url_for(f"fake://{arm.name}?time=real", mine)
    assert url_from(url, mine) == f"fake://{arm.resolve()}?time=real"
    assert url_for("/dev/ttyUSB0", mine) == url_from("/dev/ttyUSB0", mine) == "/dev/ttyUSB0"
    assert url_from("fake://first_time", mine) == "fake://first_time"
    text = arm.read_text(encoding="utf-8").replace('"fake://"', f'"{url_for(f"fake://{arm.name}", mine)}"')
    mine.write_text(text, encoding="utf-8")
    monkeypatch.chdir("/")
    with ServoBus.open(load_config(mine).bus):
        pass


def test_a_missing_fake_file_is_named_as_missing(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_file()
    path.write_text(path.read_text(encoding="utf-8").replace('"fake://"', '"fake://gone.toml"'), encoding="utf-8")
    assert hil("identify", path, "--out", path.parent / "run") == 2
    said = capsys.readouterr().err
    assert "gone.toml" in said and "does not exist" in said and "adapter plugged in" not in said
