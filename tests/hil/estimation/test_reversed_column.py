"""The warning about a recording with a reversed torque column names the column."""

import csv
import json
from pathlib import Path

import pytest

from tests.support.command_line import hil
from tests.support.paths import CONFIGS, DATA


def test_a_reversed_torque_column_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with (DATA / "dfki_double_pendulum" / "c1_sinusoids_143601.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))[:2500]
    for row in rows:
        row["tau_con2"] = str(-float(row["tau_con2"]))
    recording = tmp_path / "reversed.csv"
    with recording.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    text = (CONFIGS / "recordings" / "dfki_double_pendulum.toml").read_text(encoding="utf-8")
    arm = tmp_path / "arm.toml"
    arm.write_text(text.replace('"stribeck_load"', '"coulomb"').replace("presliding = true\n", ""), encoding="utf-8")
    assert hil("estimate", recording, "--config", arm, "--json") == 0
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert any("sign of the torque of joint 2 seems to be reversed" in warning for warning in warnings), warnings
