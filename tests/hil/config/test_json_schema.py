"""The JSON Schema for editors agrees with the models that check the TOML."""

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from hil.config.bundled import bundled_configs
from hil.config.json_schema import FILE_NAME, schema_text, toml_schema
from hil.config.schema import Config
from tests.support.command_line import hil
from tests.support.paths import CONFIGS

ALL_CONFIGS = sorted(CONFIGS.rglob("*.toml"))


def test_the_committed_schema_is_that_of_the_code() -> None:
    said = f"regenerate it: hil schema --out configs/{FILE_NAME}"
    assert (CONFIGS / FILE_NAME).read_text(encoding="utf-8") == schema_text(), said


def test_the_command_prints_it_or_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["hil"])
    assert hil("schema") == 0
    assert json.loads(capsys.readouterr().out) == toml_schema()
    assert hil("schema", "--out", tmp_path / "arm.json") == 0
    assert "#:schema ./arm.json" in capsys.readouterr().out
    assert (tmp_path / "arm.json").read_text(encoding="utf-8") == schema_text()


@pytest.mark.parametrize("path", ALL_CONFIGS, ids=lambda path: path.stem)
def test_every_configuration_names_the_schema_in_its_first_line(path: Path) -> None:
    directive, _, name = path.read_text(encoding="utf-8").splitlines()[0].partition(" ")
    assert directive == "#:schema"
    assert (path.parent / name).resolve() == (CONFIGS / FILE_NAME).resolve()


def test_it_has_every_key_with_its_words_and_no_null() -> None:
    schema = toml_schema()
    tables = set(Config.model_fields) - {"path"}
    assert set(schema["properties"]) == tables
    text = json.dumps(schema)
    assert '"null"' not in text
    joint = schema["$defs"]["JointConfig"]["properties"]
    assert "XM430-W350" in joint["model"]["enum"]
    assert joint["position_limit"]["description"] == "rad"
    assert schema["$defs"]["PortConfig"]["additionalProperties"] is False


@pytest.fixture
def validator() -> Any:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed: pip install jsonschema")
    jsonschema.Draft7Validator.check_schema(toml_schema())
    return jsonschema.Draft7Validator(toml_schema())


@pytest.mark.parametrize("path", ALL_CONFIGS, ids=lambda path: path.stem)
def test_every_configuration_is_valid_for_an_editor(validator: Any, path: Path) -> None:
    errors = validator.iter_errors(tomllib.loads(path.read_text(encoding="utf-8")))
    assert [error.message for error in errors] == []


@pytest.mark.parametrize(
    "change",
    [
        ("port", {"url": "fake://", "bawd": 1}),
        ("prot", {}),
        ("experiment", {"rate": "fast", "period": 10.0}),
        ("joints", []),
        ("arm", {"gravity": 9.81}),
    ],
    ids=["misspelt key", "misspelt table", "wrong type", "no joint", "missing key"],
)
def test_what_is_wrong_is_underlined(validator: Any, change: tuple[str, Any]) -> None:
    values = tomllib.loads(bundled_configs()["fake_two_link"].read_text(encoding="utf-8"))
    key, value = change
    assert not validator.is_valid({**values, key: value})
    assert validator.is_valid(values)
