"""`hil runs`, `hil note` and `hil diff` on the command line."""

import json
from pathlib import Path

import pytest

from tests.support.command_line import hil


def test_runs_are_listed_with_their_notes(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("note", identified, "--name", "first [b]", "--text", "new gearbox") == 0
    assert hil("runs", identified.parent) == 0
    said = capsys.readouterr().out
    assert "first [b]: new gearbox" in said.replace("\n", " ") or "first [b]" in said
    assert "yes" in said
    assert hil("runs", identified.parent, "--json") == 0
    (run,) = [run for run in json.loads(capsys.readouterr().out)["runs"] if run["path"] == str(identified)]
    assert run["note"] == {"name": "first [b]", "text": "new gearbox"}
    assert run["verdict"] == "yes" and run["arm"] == "arm"


@pytest.mark.parametrize("option", ["--name", "--text"])
@pytest.mark.parametrize("value", ["a\x1b[31mX", "a\nb", "\udcff"])
def test_a_note_has_printable_characters_only(
    identified: Path, option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert hil("note", identified, option, value) == 2
    assert (
        capsys.readouterr().err
        == f"hil: {option} {value!a} must not contain line breaks, tabs or other unprintable characters.\n"
    )
    assert not (identified / "note.json").exists()


def test_control_characters_of_a_path_are_escaped(capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("check", "a\x1b[31m\udcff.toml") == 2
    assert capsys.readouterr().err == "hil: a\\x1b[31m\\udcff.toml cannot be read: No such file or directory.\n"


def test_an_unfinished_run_is_listed_as_one(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (identified / "result.json").write_text('{"schema": 1, ', encoding="utf-8")
    assert hil("runs", identified) == 0
    assert "damaged" in capsys.readouterr().out
    (identified / "result.json").unlink()
    assert hil("runs", identified) == 0
    assert "not estimated" in capsys.readouterr().out


@pytest.mark.parametrize("what", ["runs", "note", "diff"])
def test_no_such_folder(what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    missing = tmp_path / "none"
    arguments = {"runs": [missing], "note": [missing, "--text", "x"], "diff": [missing, missing]}[what]
    assert hil(what, *arguments) == 2
    assert str(missing) in capsys.readouterr().err


def test_a_run_differs_from_itself_in_nothing(identified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert hil("diff", identified, identified) == 0
    said = capsys.readouterr().out
    assert "No significant changes" in said and "is compared with itself" in said
    _, smallest, named = said.partition("Smallest change in each term")
    assert smallest and "coulomb_1 " in named


def test_a_changed_parameter_is_named_and_drawn(
    identified: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    result = json.loads((identified / "result.json").read_text(encoding="utf-8"))
    result["parameters"]["coulomb_1"]["value"] *= 1.1
    worn = tmp_path / "worn.json"
    worn.write_text(json.dumps(result), encoding="utf-8")
    assert hil("diff", identified, worn, "--json") == 0
    assert json.loads(capsys.readouterr().out)["changed"] == ["friction_1: coulomb_1", "coulomb_1"]
    pytest.importorskip("matplotlib")
    assert hil("diff", identified, worn, "--png", tmp_path / "wear.png") == 0
    assert "Significant changes: friction_1: coulomb_1." in capsys.readouterr().out
    assert (tmp_path / "wear.png").read_bytes().startswith(b"\x89PNG")
