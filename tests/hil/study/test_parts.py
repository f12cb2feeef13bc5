"""Parts of a study without workers: draws, keys, datasets, figures, fleets, and checks before the start."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("pyarrow")
pytest.importorskip("tomli_w", reason="pip install 'hil[study]'")
pytest.importorskip("threadpoolctl", reason="pip install 'hil[study]'")

import pyarrow as pa
import pyarrow.parquet as pq

from hil.errors import ConfigError
from hil.study.checks import check_study, checked_arm
from hil.study.dataset import Dataset
from hil.study.draw import drawn, put, run_count
from hil.study.figures import Rate, figures
from hil.study.fleet import fleets
from hil.study.page import write_page
from hil.study.schema import Study, load_study
from hil.study.work import Spec, flat, work


def study(tmp_path: Path, text: str) -> Study:
    path = tmp_path / "study.toml"
    path.write_text(text, encoding="utf-8")
    return load_study(path)


EMPTY = '[study]\ntask = "empty"\n'
ARM = '[study]\ntask = "dry_run"\nconfig = "fake_two_link"\n'


def test_every_combination_of_lists(tmp_path: Path) -> None:
    made = study(tmp_path, EMPTY + "[vary]\na = [1, 2]\nb = [true, false, true]\n")
    assert run_count(made) == 6
    assert [drawn(made, run) for run in (0, 1, 5)] == [
        {"a": 1, "b": True},
        {"a": 1, "b": False},
        {"a": 2, "b": True},
    ]


def test_a_run_draws_the_same_whatever_was_drawn_before(tmp_path: Path) -> None:
    text = EMPTY + "runs = 50\n[vary]\na = {uniform = [1.0, 2.0]}\nb = {normal = [0.0, 1.0]}\nc = {integer = [1, 3]}\n"
    made = study(tmp_path, text + "d = {log_uniform = [0.1, 10.0]}\ne = {choice = ['x', 'y']}\nf = {count = 7}\n")
    alone = drawn(made, 31)
    every = [drawn(made, run) for run in range(50)]
    assert every[31] == alone
    assert all(1 <= each["a"] <= 2 and each["c"] in (1, 2, 3) and 0.1 <= each["d"] <= 10 for each in every)  # type: ignore[operator]
    assert [each["f"] for each in every] == list(range(7, 57))
    assert len({each["b"] for each in every}) == 50


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[study]\ntask = 'dance'\n", "task"),
        ("[study]\ntask = 'identify'\n", "needs config"),
        (EMPTY + "[vary]\na = {uniform = [2.0, 1.0]}\n", "must not be larger"),
        (EMPTY + "[vary]\na = {uniform = [1.0, 2.0]}\n", "runs is missing"),
        (EMPTY + "[vary]\na = {uniform = [1.0, 2.0], choice = [1]}\n", "give exactly one of"),
        (EMPTY + "[vary]\na = []\n", "empty list"),
        (EMPTY + "runs = 0\n", "runs"),
        (EMPTY + "colour = 1\n", "colour"),
        ("[study]\ntask = 'estimate'\n", "needs recordings"),
        ("task = \n", "not valid TOML"),
    ],
)
def test_a_bad_study_is_refused_by_name(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        study(tmp_path, text)


@pytest.mark.parametrize(
    ("vary", "said"),
    [
        ('"fake.arm.drives.7.coulomb" = [0.1]', "has no '7'"),
        ('"fake.arms.drives.0.coulomb" = [0.1]', "arms"),
        ('"experiment.rat" = [100.0]', "rat"),
        ('"experiment.rate" = [400.0, 1.0]', "run 1 "),
    ],
)
def test_a_field_that_does_not_exist_is_named_before_anything_runs(tmp_path: Path, vary: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_study(study(tmp_path, f"{ARM}[vary]\n{vary}\n"), tmp_path / "out")


def test_more_than_the_disk_holds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = study(tmp_path, EMPTY + "runs = 1000\n")
    assert check_study(made, tmp_path / "out") == 1000

    class Usage:
        free = 1_000_000

    monkeypatch.setattr("hil.study.checks.shutil.disk_usage", lambda _: Usage)
    with pytest.raises(ConfigError, match=r"1000 runs would write about 0\.004 GB"):
        check_study(made, tmp_path / "out")


def test_values_reach_the_arm(tmp_path: Path) -> None:
    made = study(tmp_path, ARM + '[vary]\n"fake.arm.drives.1.coulomb" = [0.07]\n"experiment.periods" = [3]\n')
    config = checked_arm(made, 0)
    assert config.experiment.periods == 3
    assert config.fake is not None and config.fake.arm is not None
    assert config.fake.arm.drives[1].coulomb == 0.07


def test_put_refuses_what_is_not_there() -> None:
    values = {"a": [{"b": 1}], "c": 2}
    put(values, "a.0.new", 5)
    assert values["a"] == [{"b": 1, "new": 5}]
    put(values, "x.y", 3)
    assert values["x"] == {"y": 3}
    for key in ("a.1.b", "c.d", "a.z"):
        with pytest.raises(KeyError):
            put(values, key, 1)


def test_a_run_that_fails_is_a_row() -> None:
    row = work(Spec(3, "identify", "no = 'arm'", {"a": 1}, ("*",)))
    assert row["status"] == "failed"
    assert str(row["message"]).startswith("ConfigError")
    assert row["vary.a"] == 1 and row["run"] == 3


def test_flat() -> None:
    assert dict(flat({"a": {"b": 1.5, "c": [True, None]}, "d": list(range(100))})) == {
        "a.b": 1.5,
        "a.c.0": True,
        "a.c.1": None,
    }


def test_rows_are_read_while_they_grow_and_after_compaction(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path / "rows")
    dataset.append([{"run": 2, "status": "failed", "x": None}, {"run": 0, "status": "done", "x": 1}])
    assert pq.read_table(tmp_path / "rows").num_rows == 2
    again = Dataset(tmp_path / "rows")
    again.append([{"run": 1, "status": "done", "x": 2.5, "y": "text"}, {"run": 3, "status": "done", "y": 4}])
    assert again.done() == {0, 1, 2, 3}
    before = again.table()
    assert before.column("run").to_pylist() == [0, 1, 2, 3]
    assert before.column("x").to_pylist() == [1.0, 2.5, None, None]
    again.compact()
    assert again.table().equals(before)
    assert len(list((tmp_path / "rows").glob("*.parquet"))) == 1
    assert pq.read_table(tmp_path / "rows").equals(before)


def test_a_crash_in_compaction_doubles_no_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = Dataset(tmp_path / "rows")
    for run in range(3):
        dataset.append([{"run": run, "status": "done"}])
    monkeypatch.setattr(Path, "unlink", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        dataset.compact()
    assert Dataset(tmp_path / "rows").table().column("run").to_pylist() == [0, 1, 2]


@given(st.integers(0, 500), st.integers(0, 500))
def test_a_rate_lies_within_its_interval(count: int, more: int) -> None:
    rate = Rate(count, count + more)
    low, high = rate.interval
    assert 0.0 <= low <= high <= 1.0
    if rate.of:
        assert low - 1e-12 <= rate.share <= high + 1e-12


def test_wilson_interval_as_published() -> None:
    low, high = Rate(81, 263).interval  # R. G. Newcombe, Statistics in Medicine 17 (1998) 857, Table I
    assert (round(low, 4), round(high, 4)) == (0.2553, 0.3662)


def test_figures_of_rows() -> None:
    table = pa.table(
        {
            "run": [0, 1, 2],
            "status": ["done", "done", "failed"],
            "message": ["", "", "SafetyStop: at 3.1 rad"],
            "verdict.trust": ["yes", "no", None],
            "x": [1.0, 3.0, None],
        }
    )
    found = figures(table)
    assert (found.done.count, found.done.of) == (2, 3)
    assert found.categories["verdict.trust"]["yes"].count == 1
    assert found.failures == {"SafetyStop: at … rad": 1}
    (spread,) = found.spreads
    assert spread.name == "x" and spread.quantiles[2] == 2.0


def test_the_arm_unlike_its_fleet_is_found_and_no_other() -> None:
    rng = np.random.default_rng(5)
    friction = 0.05 * (1 + 0.05 * rng.standard_normal(20))
    friction[7] = 0.08
    poor = rng.standard_normal(20) * 0.002 + 0.3
    poor[3] = 0.4  # far off, but with a correspondingly large standard error
    std = np.full(20, 1e-4)
    std[3] = 0.1
    table = pa.table(
        {
            "recording": [f"arm_{index}" for index in range(20)],
            "parameters.coulomb_1.value": friction,
            "parameters.coulomb_1.std": np.full(20, 1e-4),
            "parameters.gravity_1.value": poor,
            "parameters.gravity_1.std": std,
        }
    )
    (found,) = fleets(table)
    assert len(found.arms) == 20
    assert max(abs(each) for each in found.arms[7].deviations) > 4.0 > max(map(abs, found.arms[3].deviations))
    assert [(each.recording, each.name) for each in found.unlike] == [("arm_7", "coulomb_1")]
    assert math.isclose(found.spreads[0].spread, 0.0025, rel_tol=0.5)


def test_arms_are_compared_with_those_of_their_own_type(tmp_path: Path) -> None:
    kinds = ["XM430-W350, XM430-W350"] * 6 + ["XL330-M288, XL330-M288"] * 4 + [None]
    values = [0.05] * 6 + [0.01] * 4 + [None]
    table = pa.table(
        {
            "recording": [f"runs/arm_{index}" for index in range(11)],
            "status": ["done"] * 10 + ["failed"],
            "message": [""] * 10 + ["no samples"],
            "arm_type": kinds,
            "verdict.trust": ["yes"] * 10 + [None],
            "parameters.coulomb_1.value": [value and value * (1 + 0.01 * i) for i, value in enumerate(values)],
            "parameters.coulomb_1.std": [1e-5] * 10 + [None],
        }
    )
    larger, smaller = fleets(table)
    assert (larger.type, len(larger.arms), len(smaller.arms)) == ("XM430-W350, XM430-W350", 6, 4)
    assert not larger.unlike and not smaller.unlike
    write_page(table, "fleet", tmp_path / "study.html")
    page = (tmp_path / "study.html").read_text(encoding="utf-8")
    assert "Fleet of XL330-M288, XL330-M288: 4 arms" in page and "arm_9" in page and "No arm is an outlier" in page


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ("5", "vary.fake.seed = 5: must be a list of values or a draw"),
        ("[[1]]", r"vary.fake.seed\[1\] = \[1\]: must be a number"),
        ("{ unifrom = [1, 2] }", "vary.fake.seed.unifrom is not a known key; did you mean uniform"),
        ("{ log_uniform = [3, 1] }", "vary.fake.seed: log_uniform = .* the first must not be larger"),
        ("{ choice = [] }", "vary.fake.seed.choice = .*: needs at least 1"),
    ],
)
def test_what_is_wrong_in_vary_is_named_without_the_schema_s_own_words(
    values: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "study.toml"
    path.write_text(f'[study]\ntask = "empty"\nruns = 2\n[vary]\n"fake.seed" = {values}\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        load_study(path)
    assert "union[" not in str(caught.value) and "~" not in str(caught.value)


def test_an_arm_without_a_parameter_is_no_outlier_in_it() -> None:
    values = [0.05] * 5 + [None]
    columns = {"recording": list("abcdef"), "parameters.load_1.value": values, "parameters.viscous_1.value": [0.1] * 6}
    (found,) = fleets(pa.table(columns))
    assert not found.unlike and np.isnan(found.arms[5].deviations[0])
