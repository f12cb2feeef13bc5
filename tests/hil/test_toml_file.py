"""Every reader of TOML accepts the same files, and what is wrong with others is said in words."""

from collections.abc import Callable
from pathlib import Path

import pytest

from hil.config.recording import load_recording_config
from hil.config.schema import load_config
from hil.errors import ConfigError
from hil.fakes.description import DescriptionError, load_fake
from hil.study.schema import load_study
from hil.toml_file import TomlFileError, load_toml
from tests.support.paths import CONFIGS

ARM = (CONFIGS / "first_time.toml").read_text(encoding="utf-8")
READERS: tuple[Callable[[Path], object], ...] = (load_config, load_fake, load_recording_config)


@pytest.mark.parametrize("read", READERS)
def test_a_byte_order_mark_is_no_part_of_the_file(read: Callable[[Path], object], tmp_path: Path) -> None:
    """As Windows' Notepad writes it."""
    path = tmp_path / "arm.toml"
    path.write_text(ARM, encoding="utf-8-sig")
    read(path)


@pytest.mark.parametrize("read", (*READERS, load_study))
@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"a = " + 3000 * b"[" + 3000 * b"]", "too many nested brackets"),
        (b"a = 1\nb = " + 5000 * b"9", r"arm\.toml: not valid TOML: a number has too many digits \(at line 2\)"),
        ("a = 1\n# Länge".encode("latin-1"), "not UTF-8 text, from line 2 on:\n  # Länge"),
        (b"[port]\nbaud = 1\n# again\nbaud = 2\n", r"baud is given twice in \[port\], on lines 2 and 4\."),
    ],
)
def test_every_reader_says_what_is_wrong(
    read: Callable[[Path], object], content: bytes, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "arm.toml"
    path.write_bytes(content)
    with pytest.raises((ConfigError, DescriptionError), match=said) as raised:
        read(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a = 1\na = 2\n", "a is given twice, on lines 1 and 2."),
        ("[x]\na = 1\n[y]\na = 1\n[x]\nb = 2", "[x] is given twice, on lines 1 and 5."),
        ("[[x]]\na = 1\n[[x]]\na = 1\nb = 1\nb = 2\n", "b is given twice in the [[x]] of line 3, on lines 5 and 6."),
        ("[x]\na.b = 1\na = 2\n", "a on line 3 is already given in [x], in another form."),
        ("a = {b = 1, b = 2}", "Duplicate inline table key 'b'"),
        ("[a]\nx = [\n  [1, 2],\n]\nx = 1\n", "x is given twice in [a], on lines 2 and 5."),
        ("[a]\nx = 1\nx = [\n  1,\n]\n", "x is given twice in [a], on lines 2 and 3."),
        ('[a]\ny = """\nx = 1\n[b]\n"""\nx = 1\nx = 2\n', "x is given twice in [a], on lines 6 and 7."),
        ("[[a]]\n[a.b]\nx = 1\n[[a]]\n[a.b]\nx = 1\nx = 2\n", "x is given twice in [a.b], on lines 6 and 7."),
        ("[a]\nb = 1\n[[a]]\n", "line 1 has [a] and line 3 has [[a]]. Write [[a]], with two brackets"),
        ("[[x]]\na = 1\n[x]\na = 1\n", "line 3 has [x] and line 1 has [[x]]. Write [[x]], with two brackets"),
    ],
)
def test_what_is_given_twice_is_named_with_both_lines(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text(text, encoding="utf-8")
    with pytest.raises(TomlFileError) as raised:
        load_toml(tmp_path / "arm.toml")
    assert said in str(raised.value)


def test_a_list_of_tables_in_single_brackets(tmp_path: Path) -> None:
    (tmp_path / "arm.toml").write_text('[port]\nurl = "fake://x"\n[joints]\nid = 1\n', encoding="utf-8")
    with pytest.raises(ConfigError) as raised:
        load_config(tmp_path / "arm.toml")
    assert "Write [[joints]] with double brackets, once for each entry, instead of [joints]" in str(raised.value)
