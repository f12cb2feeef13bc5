"""What the documents and examples import is public: its module lists it in `__all__`, and the list is correct."""

import ast
import re
from collections.abc import Iterator
from importlib import import_module, util
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
REFERENCE = re.compile(r"^::: (hil[\w.]*)", re.M)
PIECES = "architecture.md"
"""Its blocks are fragments of the package's own files; tests/project/test_architecture.py applies them."""


def _imported(source: str) -> Iterator[tuple[str, str]]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "hil":
            yield from ((node.module, name.name) for name in node.names)


def _sources() -> Iterator[str]:
    for page in PAGES:
        if page.name != PIECES:
            yield from re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    for example in sorted((ROOT / "examples").glob("*.py")):
        yield example.read_text(encoding="utf-8")


def _is_module(name: str) -> bool:
    try:
        return util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def _referenced(page: Path) -> Iterator[tuple[str, str | None]]:
    for name in REFERENCE.findall(page.read_text(encoding="utf-8")):
        module, _, last = name.rpartition(".")
        yield (name, None) if _is_module(name) else (module, last)


PUBLIC = sorted({pair for source in _sources() for pair in _imported(source)})
DESCRIBED = sorted({pair for page in PAGES for pair in _referenced(page)}, key=str)


def test_there_are_documents_and_examples_to_judge() -> None:
    assert {"hil", "hil.config.schema", "hil.drivers.bus"} <= {module for module, _ in PUBLIC}
    assert {"hil.errors", "hil.results.result"} <= {module for module, _ in DESCRIBED}


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_an_imported_name_is_public(module: str, name: str) -> None:
    assert name in import_module(module).__all__


@pytest.mark.parametrize(("module", "name"), DESCRIBED)
def test_a_module_of_the_reference_lists_its_names(module: str, name: str | None) -> None:
    names = import_module(module).__all__
    assert name is None or name in names


def test_every_list_names_what_its_module_has() -> None:
    listed = [path for folder in ("hil", "drivers", "estimator", "fakes") for path in (ROOT / folder).rglob("*.py")]
    own = {path.resolve() for path in listed if "__all__ = [" in path.read_text(encoding="utf-8")}
    assert len(own) > 20
    for path in own:
        parts = path.relative_to(ROOT).with_suffix("").parts
        dotted = ".".join(parts if parts[0] == "hil" else ("hil", *parts)).removesuffix(".__init__")
        module = import_module(dotted)
        assert module.__all__ and len(set(module.__all__)) == len(module.__all__), dotted
        for name in module.__all__:
            assert hasattr(module, name), f"{dotted}.{name}"
