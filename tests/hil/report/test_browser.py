"""The report in a real browser without a network: opens fast, no errors or requests; figures and tooltips work."""

import json
import re
import shutil
import subprocess
import time
from html import unescape
from pathlib import Path
from typing import Any

import pytest

from hil.report.page import write_report
from hil.report.run_data import RunData

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MOST_SECONDS = 2.0

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt-get install chromium")

# Inserted at the beginning, it records all errors; after the page's own script, it simulates a visitor.
_BEFORE = """<script>
window.seen = { errors: [] };
addEventListener("error", (event) => seen.errors.push(String(event.message || event.target.tagName)), true);
addEventListener("securitypolicyviolation", (event) => seen.errors.push("policy: " + event.blockedURI));
</script>"""
_AFTER = """<script>
addEventListener("load", () => {
  seen.seconds = performance.now() / 1000;
  const loaded = performance.getEntriesByType("resource").map((entry) => entry.name);
  seen.requests = loaded.filter((name) => !name.startsWith("data:"));
  const drawn = [...document.querySelectorAll("figure:not(.motion) svg")];
  const visible = drawn.filter((svg) => svg.getBoundingClientRect().width > 0);
  const slider = document.querySelector(".motion input");
  const links = () => document.querySelector(".links").getAttribute("points");
  const first = links();
  slider.value = Math.floor(slider.max / 2);
  slider.dispatchEvent(new Event("input"));
  seen.moved = links() !== first && document.querySelector(".motion output").textContent !== "0.00 s";
  seen.figures = visible.map((svg) => [svg.getAttribute("aria-label"), svg.getBoundingClientRect().width]);
  seen.overflow = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const svg = visible.find((one) => one.closest("figure").id.startsWith("figure-position"));
  const box = svg.getBoundingClientRect();
  const at = (type, part) => svg.dispatchEvent(new PointerEvent(type, {
    clientX: box.left + part * box.width, clientY: box.top + 0.5 * box.height, pointerType: "mouse", pointerId: 1 }));
  svg.setPointerCapture = () => {};
  at("pointermove", 0.5);
  seen.reading = document.querySelector(".reading").innerText;
  const ticks = () => [...svg.querySelectorAll(".x-axis text")].map((text) => text.textContent);
  seen.before = ticks();
  at("pointerdown", 0.5); at("pointermove", 0.6); at("pointerup", 0.6);
  seen.zoomed = ticks();
  const drag = (type, part) => svg.dispatchEvent(new PointerEvent(type, { shiftKey: true,
    clientX: box.left + part * box.width, clientY: box.top + 0.5 * box.height, pointerType: "mouse", pointerId: 1 }));
  drag("pointerdown", 0.5); drag("pointermove", 0.3); drag("pointerup", 0.3);
  seen.panned = ticks();
  HTMLAnchorElement.prototype.click = function () { seen.saved = [this.download, this.href.slice(0, 5)]; };
  svg.closest("figure").querySelector(".save").click();
  document.querySelector(".back").click();
  seen.after = ticks();
  const note = document.createElement("pre");
  note.id = "seen";
  note.textContent = JSON.stringify(seen);
  document.body.append(note);
});
</script>"""


def visit(page: Path, width: int) -> dict[str, Any]:
    text = page.read_text(encoding="utf-8")
    watched = page.with_name("watched.html")
    watched.write_text(text.replace("<head>", f"<head>{_BEFORE}", 1).replace("</body>", f"{_AFTER}</body>", 1), "utf-8")
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += [f"--user-data-dir={page.parent / 'profile'}", f"--window-size={width},900"]
    command += ["--disable-background-networking", "--dump-dom", watched.as_uri()]
    dom = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    found = re.search(r'<pre id="seen">(.*?)</pre>', dom, re.DOTALL)
    assert found, dom[-2000:]
    seen: dict[str, Any] = json.loads(unescape(found[1]))
    return seen


@pytest.mark.parametrize("width", [1200, 500])
def test_a_visit(identified: Path, width: int) -> None:
    data = RunData.load(identified)
    page = identified / "report.html"
    write_report(data, page)
    started = time.perf_counter()
    seen = visit(page, width)
    assert time.perf_counter() - started < 30
    assert seen["errors"] == []
    assert seen["requests"] == []
    assert seen["seconds"] < MOST_SECONDS
    assert seen["overflow"] <= 0
    assert seen["moved"], "the slider moves the arm"
    assert len(seen["figures"]) == 15
    assert all(drawn > 0.5 * min(width, 600) for _, drawn in seen["figures"])
    assert "measured: " in seen["reading"] and "predicted: " in seen["reading"]
    assert seen["zoomed"] != seen["before"] == seen["after"]
    assert seen["panned"] not in (seen["zoomed"], seen["before"])
    assert seen["saved"][0].startswith("position") and seen["saved"][1] == "blob:"
