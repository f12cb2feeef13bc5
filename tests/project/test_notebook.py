"""The notebook in examples/: its cells run without Jupyter and reproduce the stored output."""

import ast
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hil.config.bundled import bundled_configs
from hil.config.schema import load_config
from hil.fakes.plants.arm import base_parameters
from tests.support.edits import replaced
from tests.support.paths import ROOT

NOTEBOOK = ROOT / "examples" / "identify_an_arm.ipynb"
MOST_BYTES = 200_000


def code_cells() -> list[dict[str, Any]]:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def run(source: str, names: dict[str, Any]) -> Any:
    """Run a cell; return the value of its last line if that is an expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, str(NOTEBOOK), "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names)


def nothing() -> None:
    """The output for a value without such a method."""


def assert_as_shown(shown: str, now: str) -> None:
    """The stored text is what the program says now: the same words, and the same numbers within 30 %."""
    number = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
    assert number.sub("#", shown).split() == number.sub("#", now).split(), f"execute the notebook again: {now}"
    pairs = zip(map(float, number.findall(shown)), map(float, number.findall(now)), strict=True)
    for stored, found in pairs:
        assert stored == pytest.approx(found, rel=0.3, abs=1e-9), f"execute the notebook again: {now}"


SHORTER = (
    ("rate = 400.0 ", "rate = 200.0 "),
    ("period = 10.0 ", "period = 2.0 "),
    ("band = [0.1, 5.0]", "band = [0.5, 6.0]"),
)


@pytest.mark.usefixtures("few_stops")
def test_its_cells_run_on_shorter_experiments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of the bundled names in the working folder take precedence."""
    for name in ("fake_two_link", "first_time"):
        text = replaced(bundled_configs()[name].read_text(encoding="utf-8"), *SHORTER)
        (tmp_path / name).write_text(text.replace('friction = "auto"', 'friction = "stribeck"'), encoding="utf-8")
    names = assert_cells_run(tmp_path, monkeypatch, lambda shown, now: None)
    former = names["result"].run
    run(next(text for cell in code_cells() if "hil.identify" in (text := "".join(cell["source"]))), names)
    assert names["result"].run != former, "it can be executed a second time"


@pytest.mark.slow
def test_its_cells_run_and_give_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_cells_run(tmp_path, monkeypatch, assert_as_shown)


def assert_cells_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compare: Callable[[str, str], None]
) -> dict[str, Any]:
    """Every cell runs in `tmp_path` and gives a value of the kinds that are stored. compare: checks values as text.

    Returns the cells' names.
    """
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'hil[png]'")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for cell in code_cells():
        value = run("".join(cell["source"]), names)
        shown = [output["data"] for output in cell["outputs"] if "data" in output]
        assert len(shown) == (value is not None), cell["source"]
        if value is None:
            continue
        compare("".join(shown[0]["text/plain"]), repr(value))
        for kind, method in (("text/html", "_repr_html_"), ("image/png", "_repr_png_")):
            assert (kind in shown[0]) == (getattr(value, method, nothing)() is not None)
    assert (names["result"].run / "report.html").is_file()
    return names


def test_the_values_it_shows_are_those_of_the_fake_arm() -> None:
    """Tolerances that any version of the estimator must meet, because its error bars may change."""
    shown = next(text for text in texts() if "trust this model: yes" in text)
    truth = load_config(bundled_configs()["fake_two_link"]).fake
    assert truth is not None
    for name, value in base_parameters(truth.arm).items():
        found = re.search(rf"^\s*{name}\s+(\S+) \+- ", shown, re.MULTILINE)
        assert found and float(found[1]) == pytest.approx(value, rel=0.01)


def texts() -> list[str]:
    return ["".join(each["data"]["text/plain"]) for cell in code_cells() for each in cell["outputs"] if "data" in each]


def test_it_was_executed_in_order_and_is_small() -> None:
    text = NOTEBOOK.read_text(encoding="utf-8")
    assert len(text.encode()) < MOST_BYTES
    assert [cell["execution_count"] for cell in code_cells()] == list(range(1, len(code_cells()) + 1))
    assert not [output for cell in code_cells() for output in cell["outputs"] if output["output_type"] == "error"]
    assert not re.search(r'"/(home|root|tmp|work|Users)/', text), "a path of the machine it was executed on"


@pytest.mark.slow
def test_it_executes_in_a_kernel(tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed: pip install 'hil[notebook]'")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed: pip install 'hil[notebook]'")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed: pip install 'hil[notebook]'")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
    assert list(tmp_path.glob("runs/*/result.json"))
