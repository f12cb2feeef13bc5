"""The report: content, size, time, and incomplete runs."""

import json
import re
import time
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from hil.errors import ResultError, RunFolderError
from hil.report.chart import Chart
from hil.report.page import make_page, render, sections, write_report
from hil.report.pictures import figures, save_pictures
from hil.report.png import draw_figures, save_png
from hil.report.run_data import RunData
from hil.report.section import Section
from hil.report.sections.parameters import _row
from hil.report.sections.spectra import _excitation
from hil.report.sections.verdict import verdict
from hil.results.parts import Quantity

MOST_BYTES = 3_000_000
MOST_SECONDS = 5.0


def test_it_is_one_file_without_requests_within_size_and_time(identified: Path) -> None:
    started = time.perf_counter()
    write_report(RunData.load(identified), identified / "report.html")
    assert time.perf_counter() - started < MOST_SECONDS
    page = (identified / "report.html").read_text(encoding="utf-8")
    assert len(page.encode()) < MOST_BYTES
    loads = [value for name, value in attributes(page) if name in ("src", "href", "srcset", "action", "data")]
    assert all(value.startswith(("#", "data:")) for value in loads), loads
    assert not re.findall(r"@import|url\((?!#)|fetch\(|XMLHttpRequest", page)


def attributes(page: str) -> list[tuple[str, str]]:
    found: list[tuple[str, str]] = []

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            found.extend((name, value or "") for name, value in attrs)

    Parser().feed(page)
    return found


def test_words_come_first_then_every_section_and_figure(identified: Path) -> None:
    data = RunData.load(identified)
    made = sections(data)
    assert [section.key for section in made] == [
        *("verdict", "parameters", "motion", "prediction", "friction", "spectra"),
        *("correlation", "limits", "timing", "next", "provenance"),
    ]
    page = make_page(data)
    assert page.index("predicts a held-out motion") < page.index("<table")
    for figure in figures(data):
        assert page.count(f'aria-label="{figure.title}') == 2
    for said in ("inertia_1", "gravity_2", "coulomb_2", "XM430-W350, ID 1", "seed"):
        assert said in page


def test_the_moving_arm_says_what_it_shows(identified: Path) -> None:
    page = make_page(RunData.load(identified))
    assert "<figcaption>The arm in the fitted period, as measured; gravity points down. Play it" in page


def test_a_run_in_steps_shows_prediction_beside_what_was_seen(identified: Path) -> None:
    path = identified / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    figures_of_step = [[0.1234 * row, -0.2] for row in range(6)]
    step = {"name": "pilot", "peak_torque": [0.2, 0.1], "within_quantile": True}
    step |= dict.fromkeys(("predicted_median", "predicted_quantile_99", "seen"), figures_of_step)
    result["steps"] = [step, {**step, "name": "full", "within_quantile": False}]
    path.write_text(json.dumps(result), encoding="utf-8")
    page = make_page(RunData.load(identified))
    assert "In full, a peak exceeded" in page
    assert "pilot, peak torque shoulder 0.2 N m and elbow 0.1 N m" in page
    assert "0.617" in page


def test_names_and_events_cannot_break_out_of_the_page(identified: Path) -> None:
    with (identified / "events.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps({"time": 99.0, "event": "<script>alert(1)</script>"}) + "\n")
    page = make_page(RunData.load(identified))
    assert "<script>alert(1)" not in page
    assert "&lt;script&gt;alert(1)" in page


def test_a_run_without_held_out_or_period_leaves_those_sections_out(identified: Path) -> None:
    (identified / "period.npz").unlink()
    path = identified / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    result["validation"] = {}
    result["verdict"]["sentences"] = ["No other motion checked it."]
    del result["truth"]
    path.write_text(json.dumps(result), encoding="utf-8")
    data = RunData.load(identified)
    keys = [section.key for section in sections(data)]
    assert keys == ["verdict", "parameters", "correlation", "limits", "timing", "next", "provenance"]
    page = make_page(data)
    assert "held-out" not in page and "truth" not in page


@pytest.mark.parametrize(
    ("trust", "tone", "title"),
    [("yes", "good", "can be trusted"), ("with care", "fair", "with care"), ("no", "poor", "Do not trust")],
)
def test_the_verdict_is_the_results_own(identified: Path, trust: str, tone: str, title: str) -> None:
    path = identified / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    result["verdict"] = {"trust": trust, "weakest": "coupling", "sentences": ["Joint 2 has play.", "Fix it."]}
    result["warnings"] = ["The supply sagged."]
    path.write_text(json.dumps(result), encoding="utf-8")
    section = verdict(RunData.load(identified))
    assert section.tone == tone and title in section.title
    assert section.bullets[:3] == ("Joint 2 has play.", "Fix it.", "Warning: The supply sagged.")
    assert title in make_page(RunData.load(identified))


def test_missing_replies_and_an_undetermined_parameter_are_drawn_and_said(identified: Path) -> None:
    path = identified / "period.npz"
    arrays = dict(np.load(path))
    arrays["identify_position"][1, 50:60] = np.nan
    np.savez(path, **arrays)
    path = identified / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    name = "coulomb_width_1"
    result["extra"][name]["std"] = float("inf")
    index = result["covariance"]["names"].index(name)
    for other in range(len(result["covariance"]["names"])):
        result["covariance"]["matrix"][index][other] = result["covariance"]["matrix"][other][index] = 0.0
    result["covariance"]["matrix"][index][index] = float("inf")
    path.write_text(json.dumps(result), encoding="utf-8")
    page = make_page(RunData.load(identified))
    assert "not determined" in page
    assert "nan" not in "".join(re.findall(r' d="([^"]*)"', page)).lower()


def test_pictures_stand_alone_as_svg_and_png(identified: Path, tmp_path: Path) -> None:
    data = RunData.load(identified)
    count = len(figures(data))
    svgs = save_pictures(figures(data), tmp_path / "pictures", "svg")
    assert len(svgs) == len(set(svgs)) == count
    for path in svgs:
        assert ET.parse(path).getroot().tag.endswith("svg")
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'hil[png]'")
    for figure in {type(figure): figure for figure in figures(data)}.values():
        save_png(figure, tmp_path / f"{figure.name}.png")
        assert (tmp_path / f"{figure.name}.png").read_bytes().startswith(b"\x89PNG")


def test_each_joint_has_a_colour_and_the_legend_hides_no_curve() -> None:
    torque = np.random.default_rng(1).normal(size=(7, 200))
    period: Any = SimpleNamespace(torque=torque, position=torque, predicted=torque, rate=100.0)
    data: Any = SimpleNamespace(fitted=period, names=[f"long_name_of_joint_{number}" for number in range(1, 8)])
    figure = _excitation(data, period, [[number] for number in range(1, 8)]).figure
    assert isinstance(figure, Chart) and len({series.colour for series in figure.series}) == 7
    pytest.importorskip("matplotlib", reason="matplotlib is not installed: pip install 'hil[png]'")
    drawn = draw_figures([figure])
    drawn.canvas.draw()
    (axes,) = drawn.axes
    legend = axes.get_legend().get_window_extent()
    assert axes.bbox.x1 <= legend.x0 and legend.x1 <= drawn.bbox.x1


def test_runs_that_are_not_whole_are_named(identified: Path, tmp_path: Path) -> None:
    def said(kind: type[Exception], text: str) -> None:
        with pytest.raises(kind, match=text):
            RunData.load(identified)

    def spoil(name: str, content: Any) -> None:
        path = identified / name
        kept = path.read_bytes()
        path.write_text(content, encoding="utf-8") if content is not None else path.unlink()
        said(ResultError if name == "result.json" else RunFolderError, rf"{re.escape(name)}")
        path.write_bytes(kept)

    spoil("result.json", None)
    spoil("result.json", '{"schema": 1, "par')
    spoil("result.json", '{"schema": 99}')
    spoil("period.npz", "no zip")
    spoil("samples.npy", "no npy")
    spoil("run.json", '{"schema": 99}')
    spoil("events.jsonl", "no json\n{}\n")
    with pytest.raises(ResultError, match="nowhere cannot be read"):
        RunData.load(tmp_path / "nowhere")


def test_text_of_the_terminal_is_set_for_a_page() -> None:
    page = render("arm", "2026-01-01T00:00:00", [Section("words", "Words", ("see `hil pose` <b>: 1 +- 0.2 m",))])
    assert "see <code>hil pose</code> &lt;b&gt;: 1 ± 0.2 m" in page


@pytest.mark.parametrize(
    ("value", "std", "truth", "shown"),
    [(-3.3e-05, 2e-06, -2.2407e-05, ("\u22120.0000330", "\u22120.0000224")), (1.5, 0.0, 1.4999, ("1.5", "1.4999"))],
)
def test_a_true_value_is_written_as_the_value_beside_it(
    value: float, std: float, truth: float, shown: tuple[str, str]
) -> None:
    row = _row("viscous_1", Quantity(value, std, "N m s/rad"), {"viscous_1": truth}, {})
    assert (row[3], row[-1]) == shown
