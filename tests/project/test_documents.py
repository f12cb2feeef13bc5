"""Every command in the README and the docs is run on the fake bus, and statements about the code are checked."""

import ast
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from hil.cli.app import COMMANDS, main
from hil.report import png
from hil.report.chart import Figure
from hil.report.png import draw_figures
from tests.support.edits import replaced
from tests.support.paths import ROOT
from tests.support.processes import forked

DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN_HERE = [path for path in DOCUMENTS if path.name != "first_evening.md"]
"""tests/project/test_first_evening.py types that page."""
RUN_BY_OTHERS = {
    "hil identify configs/fake_open_manipulator_x.toml": "tests/hil/estimation/test_chain_run.py",
}
"""Commands of a quarter of a minute that other tests run on the same file."""
SHORT = (
    ("rate = 400.0 ", "rate = 200.0 "),
    ("period = 10.0 ", "period = 2.0 "),
    ("band = [0.1, 5.0]", "band = [0.5, 6.0]"),
    ("[experiment]\n", "[experiment]\nheld_out = false\n"),
)

FEWER_SAMPLES = """[vary]
"experiment.rate" = [200.0]
"experiment.held_out" = [false]
"""

RUN_ELSEWHERE = {
    "sudo": "changes the machine",
    "git": "needs the repository's address",
    "make": "test_make_targets_exist; CI runs make test",
    "pip": "test_packaging installs into a clean environment",
    "python3": "test_packaging makes a clean environment",
    ".venv/bin/python": "test_packaging, CI",
    ".venv-hil/bin/pip": "like pip, for programs that need another dynamixel-sdk",
    "export": "tests/fakes/test_ci_page.py sets HIL",
    "pytest": "tests/fakes/test_ci_page.py",
    "mkdocs": "test_the_site_builds",
}
"""Commands that these tests do not run unchanged, with the reason or the test that runs them."""


def commands(document: Path) -> Iterator[str]:
    """Shell lines in fenced `sh` blocks, indented blocks and workflow steps."""
    text = document.read_text(encoding="utf-8")
    for block in re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        yield from filter(None, map(str.strip, block.splitlines()))
    unfenced = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    for line in re.findall(r"^ {4}((?:hil|make|python3?|pip|sudo|git|\.venv/bin/\S+) .*)$", unfenced, re.MULTILINE):
        yield line.split("  #")[0].strip()
    yield from re.findall(r"^- run: (.*)$", text, re.MULTILINE)


@pytest.fixture
def place(identified: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder like a checkout, with short periods for the fake arms, and a finished run."""
    here = tmp_path / "place"
    (here / "configs").mkdir(parents=True)
    for path in (ROOT / "configs").glob("*.toml"):
        text = path.read_text(encoding="utf-8")
        if path.stem.startswith(("fake", "first_time")):
            text = cut_short(text)
            (here / path.stem).write_text(text, encoding="utf-8")  # takes precedence over the bundled file of that name
        (here / "configs" / path.name).write_text(text, encoding="utf-8")
    new = text_of_new_servos((here / "configs" / "fake_two_link.toml").read_text(encoding="utf-8"))
    (here / "configs" / "new.toml").write_text(new, encoding="utf-8")
    for urdf in (ROOT / "configs").glob("*.urdf"):
        (here / "configs" / urdf.name).symlink_to(urdf)
    shutil.copytree(ROOT / "examples", here / "examples")
    study = here / "examples" / "studies" / "friction.toml"
    fewer = replaced(
        study.read_text(encoding="utf-8"),
        ("runs = 6", "runs = 2"),
        ("[vary]", FEWER_SAMPLES),
        ("= [2.0]", "= [1.0]"),
        ("= [0.5]", "= [1.0]"),
    )
    study.write_text(fewer, encoding="utf-8")
    (here / "runs").mkdir()
    identified.rename(here / "runs" / "finished")
    monkeypatch.chdir(here)
    monkeypatch.setattr(sys, "argv", sys.argv)
    monkeypatch.setattr(png, "draw_figures", drawn_coarsely)
    return here


def drawn_coarsely(figures: Sequence[Figure], dpi: int = 90) -> Any:
    """With few pixels and without a layout, which take most of the time; tests/hil/report/test_report.py has both."""
    canvas = draw_figures(figures, min(dpi, 20))
    canvas.set_layout_engine("none")
    return canvas


def text_of_new_servos(text: str) -> str:
    """The same arm with factory-new servos at 57600 baud, and with ID 2 unused."""
    new = text.replace("[[fake.servos]]\n", "[[fake.servos]]\nbaud = 57600\n")
    return new.replace("baud = 57600\nid = 2", "baud = 57600\nid = 9")


def cut_short(text: str) -> str:
    for old, new in SHORT:
        text = text.replace(old, new, 1)
    return text


def as_here(command: str) -> list[str]:
    """The command's arguments for the fake bus: a real port is replaced by the fake arm, and questions are answered
    yes.
    """
    words = shlex.split(re.sub(r" > \S+$", "", command))
    port = "configs/new.toml" if "57600" in words else "configs/fake_two_link.toml"
    words = [re.sub(r"^/dev/tty\w+$", port, word) for word in words]
    words = [re.sub(r"^runs/\d{8}-\d{6}-\w+$", "runs/finished", word) for word in words]
    if words[0] == ".venv/bin/hil":
        words[0] = "hil"
    if words[:2] in (["hil", "setup"], ["hil", "init"]):
        words.append("--yes")
    if words[:2] == ["hil", "dry-run"]:
        words += ["--arms", "20"]
    return ["1" if before == "--workers" else word for before, word in zip(["", *words], words, strict=False)]


@pytest.mark.parametrize("document", RUN_HERE, ids=lambda path: path.name)
def test_commands_run(document: Path, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if not Path("my_arm.toml").exists():
        Path("my_arm.toml").write_text(Path("configs/fake_two_link.toml").read_text("utf-8"), "utf-8")
        Path("first_run").symlink_to("runs/finished")
    for command in commands(document):
        words = as_here(command)
        if command in RUN_BY_OTHERS:
            assert Path(words[2]).stem in (ROOT / RUN_BY_OTHERS[command]).read_text(encoding="utf-8")
        elif words[0] == "hil" and words[1] != "fake":
            sys.argv = words
            with pytest.raises(SystemExit) as caught:
                main()
            printed = capsys.readouterr()
            assert not caught.value.code, f"{command}: {printed.out[-500:]}{printed.err[-1000:]}"
            if words[1] == "init":
                mine = Path("my_arm.toml")
                mine.write_text(cut_short(mine.read_text(encoding="utf-8")), encoding="utf-8")
        elif words[0] == "hil":
            serve(words)
        elif words[0] == "python":  # a benchmark, which takes minutes, or an example, which test_examples runs
            ast.parse((ROOT / words[1]).read_text(encoding="utf-8"))
        else:
            assert words[0] in RUN_ELSEWHERE, f"{document.name}: nothing runs {command!r}"


def serve(words: list[str]) -> None:
    """A command that runs until stopped must say where it serves, and end on request; another one ends by itself."""
    with forked.start(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        said = process.stdout.readline() if "--pty" in words else ""
        if said:
            process.terminate()
        said += process.stdout.read()
        assert process.wait(60) == 0, said


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for document in DOCUMENTS:
        wanted = {command.split()[1] for command in commands(document) if command.startswith("make ")}
        assert wanted <= targets, document.name


def test_python_blocks_are_python() -> None:
    for document in DOCUMENTS:
        for block in re.findall(r"^```python\n(.*?)^```", document.read_text(encoding="utf-8"), re.M | re.S):
            ast.parse(block)


def test_every_subcommand_is_described() -> None:
    text = "\n".join(document.read_text(encoding="utf-8") for document in DOCUMENTS)
    for name in COMMANDS:
        assert f"hil {name}" in text, f"no document mentions hil {name}"


def test_every_core_dependency_has_a_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    page = (ROOT / "docs" / "dependencies.md").read_text(encoding="utf-8")
    for requirement in project["dependencies"]:
        name = re.match(r"[\w-]+", requirement)
        assert name and f"| `{name[0]}` |" in page, requirement


def test_links_between_documents_lead_somewhere() -> None:
    for document in DOCUMENTS:
        for link in re.findall(r"\]\(([^)#:]+)(?:#[\w-]+)?\)", document.read_text(encoding="utf-8")):
            assert (document.parent / link).exists(), f"{document.name}: {link}"


def test_the_site_builds(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="mkdocs is not installed: pip install 'hil[docs]'")
    pytest.importorskip("mkdocstrings", reason="mkdocstrings is not installed: pip install 'hil[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "commands" / "index.html").read_text(encoding="utf-8")
    assert "hil identify" in page and "hil export" in page
    outside = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?://[^"]+)"', page)
    assert not [url for url in outside if "canonical" not in url], outside
