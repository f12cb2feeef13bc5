"""The functions of `import hil` match the command line: same files, same numbers, same errors."""

import itertools
import json
import logging
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hil
from hil.api.dry_run import dry_run
from hil.errors import ConfigError, CsvError, MissingExtra, ResultError, RunFolderError
from hil.estimation.changes.diff import diff_runs
from hil.results.result import SettledResult
from hil.runs.collection import find_runs
from hil.setup.finding import Level
from hil.setup.preflight import check_arm
from tests.support.command_line import hil as command
from tests.support.edits import QUICK, QUICK_WITH_HELD_OUT

ArmFile = Callable[..., Path]


@pytest.fixture(autouse=True)
def in_tmp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["hil"])


def test_identify_gives_what_the_command_writes(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    path = arm_file(*QUICK)
    heard: list[hil.Progress] = []
    result = hil.identify(path, out="by_function", on_progress=heard.append)
    assert capsys.readouterr() == ("", "")
    assert command("identify", path, "--out", "by_command", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    ours = json.loads(json.dumps(result.to_json()))
    assert "run" not in ours and result.run == Path("by_function")
    for each in (told, ours):
        del each["timing"]["estimation_seconds"]
    assert ours == told
    files = {kind: {file.name for file in Path(kind).iterdir()} for kind in ("by_function", "by_command")}
    assert files["by_function"] == files["by_command"] and "report.html" in files["by_function"]
    assert isinstance(result, SettledResult) and result.verdict.trust in {"yes", "with care", "no"}
    assert result.model.gravity_torque([0.0, 0.0]).shape == (2,)
    fractions = [each.fraction for each in heard if each.fraction is not None]
    assert fractions == sorted(fractions) and 0.9 < fractions[-1] <= 1.0
    assert [each.message for each in heard if each.message][-1] == "Estimating"
    assert any(each.message.startswith("Torque is off") for each in heard)


def test_record_then_estimate_is_identify(arm_file: ArmFile) -> None:
    path = arm_file(*QUICK_WITH_HELD_OUT)
    run = hil.record(path, out="run")
    assert run.result is None and "not estimated" in repr(run)
    assert len(run.samples) == run.timing.samples > 1000
    with pytest.raises(ResultError, match="has no estimate"):
        _ = run.model
    result = hil.estimate(run)
    assert result.parameters == hil.identify(path, out="at_once").parameters
    again = hil.load_run("run")
    assert again.result == result and set(again.periods) == {"identify", "held_out"}
    assert again.events[-1][1].startswith("Torque is off")


def test_all_samples_and_csv_files_are_estimated_too(identified: Path, tmp_path: Path) -> None:
    whole = hil.load_run(identified).result
    assert isinstance(whole, hil.Identification)
    found = hil.estimate(identified, all_samples=True)
    assert isinstance(found, hil.Estimation) and found.run == identified
    assert isinstance(hil.load_run(identified).result, hil.Estimation)
    assert "gravity_1" in {change.name for change in diff_runs(identified, identified).changes}, "it has the joints"
    gravity = found.parameters["gravity_1"].value
    assert gravity == pytest.approx(whole.parameters["gravity_1"].value, rel=0.05)
    with pytest.raises(CsvError, match=r"a\.csv cannot be read"):
        hil.estimate("a.csv")
    with pytest.raises(ValueError, match="no recording is given"):
        hil.estimate([])
    with pytest.raises(ValueError, match="not both"):
        hil.estimate(["a.csv", identified])
    with pytest.raises(ValueError, match="one run folder"):
        hil.estimate([identified, identified])


def test_a_bundled_name_a_path_and_a_loaded_configuration_are_the_same(arm_file: ArmFile) -> None:
    assert hil.check("fake_two_link").ready
    path = arm_file()
    reports = [hil.check(each) for each in (path, str(path), hil.load_config(path))]
    assert all(report.ready and report.findings for report in reports)
    assert "ready" in repr(reports[0]) and "<td>" in reports[0]._repr_html_()


def test_a_check_that_fails_says_what(arm_file: ArmFile) -> None:
    report = hil.check(arm_file(("id = 2", "id = 7")))
    assert not report.ready and report.problems
    assert report.to_json()["ready"] is False
    assert "elbow" in repr(report) and "nothing at 1000000 baud" in repr(report)
    assert report.problems[-1].fix in repr(report) and "Fix the servo problems above" in report._repr_html_()


def test_two_runs_within_a_second_have_folders_of_their_own(arm_file: ArmFile, monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [hil.record(arm_file(*QUICK)).path for _ in range(2)]
    assert len({*runs}) == 2 and all(path.parent == Path("runs") for path in runs)


def test_errors_are_typed_and_leave_no_folder_behind(arm_file: ArmFile, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        hil.identify("nowhere.toml", out="run")
    assert not Path("run").exists()
    with pytest.raises(RunFolderError):
        hil.load_run("nowhere")
    with pytest.raises(hil.HilError) as caught:
        hil.identify(arm_file(("[-3.1, 3.1]", "[-0.5, 0.5]")), out="stopped")
    assert any("Torque is off" in note for note in caught.value.__notes__)


def test_a_callback_that_raises_disturbs_nothing(arm_file: ArmFile, caplog: pytest.LogCaptureFixture) -> None:
    heard: list[hil.Progress] = []

    def refuse(progress: hil.Progress) -> None:
        heard.append(progress)
        if progress.fraction is not None and progress.fraction > 0.3:
            raise KeyError("enough")

    run = hil.record(arm_file(*QUICK), out="run", on_progress=refuse)
    assert len(run.samples) > 1000 and heard[-1].fraction == pytest.approx(0.3, abs=0.05)
    assert [each.exc_info is not None for each in caplog.records if each.levelname == "ERROR"] == [True]


@pytest.mark.usefixtures("few_stops")
def test_a_dry_run_foretells(arm_file: ArmFile, capsys: pytest.CaptureFixture[str]) -> None:
    lengths = ("rest_pose = ", "link_lengths = [0.12, 0.10]\nrest_pose = ")
    path = arm_file(lengths, ("ramp = 1.0 ", "held_out = false\nramp = 1.0 "))
    rehearsal = hil.dry_run(path, arms=20)
    code = command("dry-run", path, "--arms", "20", "--json")
    assert json.loads(capsys.readouterr().out) == rehearsal.to_json()
    assert code == (0 if rehearsal.is_safe else 1)
    assert 0.0 <= rehearsal.stop_chance <= 1.0 and min(rehearsal.largest_peak_torque) > 0.0
    assert "largest safe peak_torque" in repr(rehearsal) and "<table>" in rehearsal._repr_html_()


def test_import_is_lazy_and_its_names_are_all_there_whatever_was_imported_before() -> None:
    """Each in a process of its own, forked from one that has imported everything but hil, which takes most of the time.

    The names `hil.dry_run` of the function and of the package are one.
    """
    code = (
        "import os, sys, hil\n"
        "assert not {'numpy', 'scipy', 'pydantic', 'typer', 'rich', 'serial'} & set(sys.modules)\n"
        "import numba, numpy, pydantic, scipy.optimize\n"
        "names = 'for name in hil.__all__: getattr(hil, name)\\nassert set(hil.__all__) <= set(dir(hil))'\n"
        "for first in ('import hil.dry_run.prior', 'hil.dry_run', names):\n"
        "    child = os.fork()\n"
        "    if not child:\n"
        "        try:\n"
        "            exec(first)\n"
        "            hil.dry_run('nowhere.toml')\n"
        "        except hil.HilError as error:\n"
        "            print(error, flush=True)\n"
        "        finally:\n"
        "            os._exit(0)\n"
        "    os.waitpid(child, 0)\n"
    )
    said = subprocess.check_output([sys.executable, "-c", code], text=True).splitlines()
    assert [line.startswith("nowhere.toml cannot be read") for line in said] == [True, True, True]
    with pytest.raises(AttributeError, match="no attribute 'identfy'"):
        _ = hil.identfy  # type: ignore[attr-defined]


def test_results_show_themselves(identified_once: Path) -> None:
    run = hil.load_run(identified_once)
    result = run.result
    assert isinstance(result, hil.Identification)
    for shown in (repr(result), result._repr_html_(), repr(run), run._repr_html_()):
        assert "inertia_1" in shown and "trust this model" in shown
    assert len(repr(result).splitlines()) < 40
    assert "<script>" not in run._repr_html_()


def test_plots_are_figures_a_notebook_can_show(identified_once: Path) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'hil[png]'")
    run = hil.load_run(identified_once)
    assert isinstance(run.result, hil.Identification)
    figure = run.result.plot("residual")
    assert len(figure.axes) == 2
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert len(run.result.plot().axes) >= 4
    assert len(run.plot().axes) == 4
    with pytest.raises(ValueError, match=r"no figure name starts with 'velocity'.*residual_1"):
        run.result.plot("velocity")
    assert "matplotlib.pyplot" not in sys.modules


def test_without_matplotlib_a_plot_says_what_to_install(identified_once: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = hil.load_run(identified_once).result
    assert result is not None
    with pytest.raises(MissingExtra, match=r"pip install 'hil\[png\]'"):
        result.plot()


def test_a_result_exports_and_reports(identified: Path, tmp_path: Path) -> None:
    result = hil.load_run(identified).result
    assert isinstance(result, hil.Identification)
    written = result.export("toml", tmp_path / "arm.toml")
    np.testing.assert_equal(dict(hil.load_model(written.path).values), result.values)
    assert result.report(tmp_path / "report.html").is_file()


def test_every_public_function_says_what_it_raises() -> None:
    for function in (hil.identify, hil.estimate, hil.check, dry_run, hil.load_run):
        assert "Raises:" in (function.__doc__ or ""), function


def test_the_log_is_under_hil_and_silent_unless_asked(
    arm_file: ArmFile, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    assert any(isinstance(each, logging.NullHandler) for each in logging.getLogger("hil").handlers)
    with caplog.at_level(logging.INFO, logger="hil"):
        hil.identify(arm_file(*QUICK), out="run")
    names = {each.name for each in caplog.records}
    assert names and all(name.startswith("hil.") for name in names)
    assert any("torque on" in each.message for each in caplog.records)
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("nothing", [None, 3, ["arm.toml"]])
def test_what_names_no_configuration_is_a_type_error_that_says_what_does(nothing: Any) -> None:
    with pytest.raises(TypeError, match=r"config must be a TOML file.* not "):
        hil.check(nothing)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda run: hil.estimate(None), "recording must be a run folder"),
        (lambda run: hil.estimate([None]), "recording must be a run folder"),
        (
            lambda run: hil.estimate("run", on_progress=5),
            "on_progress must be a function that takes one Progress, not 5",
        ),
        (lambda run: hil.check("fake_two_link", on_progress=5), "on_progress must be a function"),
        (lambda run: hil.identify("fake_two_link", on_progress=5), "on_progress must be a function"),
        (lambda run: hil.dry_run("fake_two_link", on_progress=5), "on_progress must be a function"),
        (lambda run: run.result.export(None), "kind must be the name of one format"),
        (lambda run: run.result.export(["urdf", "mjcf"]), "kind must be the name of one format"),
    ],
)
def test_an_argument_of_the_wrong_type_is_named(
    call: Callable[[Any], object], said: str, identified_once: Path
) -> None:
    with pytest.raises(TypeError, match=said):
        call(hil.load_run(identified_once))
    assert not Path("runs").exists()


def test_names_that_no_file_can_have_are_configuration_errors() -> None:
    with pytest.raises(ConfigError, match=r"'a\\x00b' cannot be read: embedded null byte"):
        hil.load_config("a\0b")
    with pytest.raises(ConfigError, match=r"^x{80}\.\.\.: File name too long\.$"):
        hil.load_config("x" * 5000)


def test_a_loaded_run_equals_itself_and_its_result_every_copy(identified_once: Path) -> None:
    first, second = hil.load_run(identified_once), hil.load_run(identified_once)
    assert first in [first] and first != second and len({first, second}) == 2 and first.result == second.result
    assert [each.path for each in find_runs(str(identified_once))] == [identified_once]
    result = first.result
    assert result is not None and result.timing.estimation_seconds != 99.0
    for changes, same in (({"estimation_seconds": 99.0}, True), ({"lost_replies": 99}, False)):
        assert (replace(result, timing=replace(result.timing, **changes)) == result) == same


def test_check_says_that_the_pilot_takes_precedence_over_a_torque() -> None:
    """The torque would look like a limit that the pilot keeps."""
    given = hil.load_config("first_time")
    experiment = given.experiment.model_copy(update={"peak_torque": [0.2, 0.1]})
    for config, told in ((given, 0), (given.model_copy(update={"experiment": experiment}), 1)):
        found = [each for each in itertools.islice(check_arm(config), 3) if each.where == "experiment"]
        assert [each.found for each in found] == told * ["pilot = true takes precedence over peak_torque"]
        assert all("ignores peak_torque" in each.fix and each.level is Level.WARNING for each in found)


def test_a_result_does_not_export_the_values_of_a_later_estimate(identified_once: Path, tmp_path: Path) -> None:
    result = hil.load_run(identified_once).result
    assert isinstance(result, hil.Identification)
    other = {name: replace(each, value=2 * each.value) for name, each in result.parameters.items()}
    former = replace(result, parameters=other)
    assert result.export("toml", tmp_path / "arm.toml").path.is_file()
    with pytest.raises(ResultError, match="has been estimated again since this result was obtained"):
        former.export("toml", tmp_path / "other.toml")
    assert former.export("csv", tmp_path / "samples.csv").path.is_file(), "the recording is the same"
    assert not (tmp_path / "other.toml").exists()
