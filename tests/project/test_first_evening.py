"""docs/first_evening.md typed command by command: every step works and names the next command."""

import shlex
import shutil
from pathlib import Path

import pytest

from tests.support.first_evening import Person, Typed, arm_seconds, commands_of, evening, faults_of
from tests.support.paths import CONFIGS

PORT = f"fake://{CONFIGS / 'first_time.toml'}"
LONG = ("dry-run", "identify")


def test_the_page_has_the_path_from_the_scan_to_the_export() -> None:
    named = [words[1] for words in commands_of()]
    path = ["scan", "init", "check", "dry-run", "identify", "export"]
    places = [named.index(each) for each in path]
    assert places == sorted(places)
    assert all(words[0] == "hil" for words in commands_of())


def test_an_evening_is_judged() -> None:
    commands = [["hil", "scan", "/dev/ttyUSB0"], ["hil", "init", "/dev/ttyUSB0"], ["hil", "export", "run"]]
    done = [
        Typed(commands[0], 0, "Next: hil init /tmp/port\r\n", 1.0),
        Typed(commands[1], 0, "Wrote it.\r\nNext: hil check my_arm.toml\r\n", 1.0),
    ]
    found = faults_of(done, commands)
    assert "hil export run: not reached" in found
    assert "hil init /dev/ttyUSB0: names hil check my_arm.toml, which is not on the page" in found
    assert "the named commands end after scan -> init -> check" in found
    done.append(Typed(commands[2], 1, "Traceback", 1.0))
    assert {"hil export run: exit code 1", "hil export run: a traceback"} <= set(faults_of(done, commands))


def test_all_but_the_long_commands_work_and_name_the_next(tmp_path: Path, identified: Path) -> None:
    shutil.copytree(identified, tmp_path / "first_run")
    repeated = {tuple(words): words for words in commands_of() if words[1] not in (*LONG, "setup")}
    first, *others = repeated.values()
    person = Person(tmp_path, PORT)
    done = evening(person, [first])
    person.forked = True
    done += evening(person, others)
    assert [shlex.join(each.words) for each in done if each.code] == [], done[-1].text
    assert all(each.next or each.words[1] == "export" for each in done)
    assert "measured to sustain" in (tmp_path / "my_arm.toml").read_text(encoding="utf-8")
    assert [each for each in person.asked if each.startswith("Length from")], "init asked"


@pytest.mark.slow
def test_the_whole_page_in_virtual_time(tmp_path: Path) -> None:
    commands = commands_of()
    done = evening(Person(tmp_path, PORT), commands)
    assert faults_of(done, commands) == [], done[-1].text[-2000:]
    assert arm_seconds(tmp_path / "first_run", 400.0) <= 720.0
