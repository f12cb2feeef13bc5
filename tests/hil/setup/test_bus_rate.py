"""The rate that `hil check` measures on the fake bus, whose wire takes the time of a real one."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

import hil
from benchmarks.bus.held_rate import configured, six_servos
from benchmarks.bus.socket_line import socket_line
from hil.drivers.bus import ServoBus
from hil.fakes.bus.clock import VirtualClock
from hil.setup import bus_rate
from hil.setup.bus_rate import ExchangeMode, check_rate

ArmFile = Callable[..., Path]


def rate_of(path: Path) -> tuple[int, bool]:
    """The rate that is possible [Hz] and whether it is enough."""
    (finding,) = [each for each in hil.check(path).findings if each.what == "rate"]
    found = re.search(r"(\d+) Hz possible", finding.found)
    assert found, finding
    return int(found[1]), not finding.fix


def test_six_servos_with_shadows_hold_400_hz_at_1_mbaud(tmp_path: Path) -> None:
    possible, enough = rate_of(six_servos(tmp_path, "1_000_000"))
    assert enough and possible >= 400


def test_the_benchmarks_socket_leads_to_the_six_servos(tmp_path: Path) -> None:
    path = six_servos(tmp_path)
    with socket_line(path), ServoBus.open(configured(path, fast=True).bus) as bus:
        assert len(bus.read_positions()) == 4 and len(bus.drives) == 6


def test_a_slower_bus_does_not_and_says_so(tmp_path: Path) -> None:
    possible, enough = rate_of(six_servos(tmp_path, "115_200"))
    assert not enough and possible < 150


@pytest.mark.parametrize(("delay_ms", "least"), [(8, 90), (16, 45), (60, 12)])
def test_late_replies_of_a_slow_adapter_are_not_taken_for_the_next_ones(
    arm_file: ArmFile, delay_ms: int, least: int
) -> None:
    slow = arm_file(("adapter_latency_us = 60.0", f"adapter_latency_us = {delay_ms}e3"))
    findings = {each.what: each for each in hil.check(slow).findings}
    assert [each for each in findings.values() if each.level == "stop"] == [findings["rate"]]
    assert findings["adapter"].found == f"delays replies by {delay_ms}.0 ms, which limits the rate"
    possible, _ = rate_of(slow)
    assert least <= possible <= 1000 / delay_ms


@pytest.mark.parametrize(("rate", "is_said"), [(400, False), (840, False), (880, True)])
def test_a_rate_that_leaves_no_time_to_read_goals_back_is_said(arm_file: ArmFile, rate: int, is_said: bool) -> None:
    findings = hil.check(arm_file(("rate = 400.0 ", f"rate = {rate}.0 "))).findings
    said = [each for each in findings if each.what == "monitoring"]
    assert len(said) == is_said
    if is_said:
        assert said[0].level == "warning" and re.search(r"every \d+ ms.* time at 8[56]\d Hz or less", said[0].fix)


@pytest.mark.parametrize(
    ("times", "slowest", "fix"),
    [
        ([6e-3, 2e-3], 1.5e-3, ""),
        ([6e-3, 6e-3], 1.5e-3, "Half of the exchanges are fast enough, so other programs may be keeping"),
        ([6e-3, 6e-3], 6e-3, "Set experiment.rate to at most 150"),
        ([60e-3, 60e-3], 60e-3, "An experiment needs at least 20 Hz: raise the baud rate"),
        ([2e-3], 1.5e-3, ""),
    ],
)
def test_a_rate_is_refused_only_if_it_is_too_high_twice(
    times: list[float], slowest: float, fix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    mode = ExchangeMode(
        one_write=True, fast=False, median_s=1.5e-3, usual_s=0.0, slowest_s=slowest, longest_s=8e-3, lost=0
    )
    measured = iter(times)
    monkeypatch.setattr(bus_rate, "measure_modes", lambda _: [replace(mode, usual_s=next(measured))])
    settings = SimpleNamespace(fast_sync_read=False, one_write=True)
    bus = cast("ServoBus", SimpleNamespace(config=settings, port=SimpleNamespace(clock=VirtualClock())))
    report = check_rate(bus, 400.0)
    assert report.fix.startswith(fix) and bool(report.fix) == bool(fix)
    assert not list(measured)


@pytest.mark.parametrize(("lost", "refused"), [(2, False), (3, True)])
def test_isolated_lost_replies_are_a_warning_and_no_reason_to_change_the_file(
    lost: int, refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    used = ExchangeMode(
        one_write=True, fast=False, median_s=1e-3, usual_s=1e-3, slowest_s=1e-3, longest_s=1e-3, lost=lost
    )
    monkeypatch.setattr(bus_rate, "measure_modes", lambda _: [used, replace(used, one_write=False, lost=0)])
    bus = cast("ServoBus", SimpleNamespace(config=SimpleNamespace(fast_sync_read=False, one_write=True)))
    report = check_rate(bus, 400.0)
    assert bool(report.fix) is refused and bool(report.doubt) is not refused
    assert report.doubt.startswith("" if refused else "2 of 200 replies were lost. An experiment tolerates")
    assert bus_rate.choose_mode(bus, report.modes, (400.0,))[0].one_write is not refused


def test_a_rate_that_only_leaves_the_computer_little_time_is_not_refused(tmp_path: Path) -> None:
    """`hil identify` runs at such a rate, so `hil check` must not call it a blocking problem."""
    path = six_servos(tmp_path, "1_000_000")
    possible, _ = rate_of(path)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("rate = 400", f"rate = {possible + 10}"), encoding="utf-8")
    (finding,) = [each for each in hil.check(path).findings if each.what == "rate"]
    assert finding.level == "warning" and f"or {possible} Hz with some margin" in finding.found
    assert re.search(r"leave only [1-9] % of a period .* at most " + str(possible), finding.fix)


def test_another_program_heard_while_the_rate_is_measured_is_named(arm_file: ArmFile) -> None:
    """Its packets collide with replies, so cables and exchange modes must not be blamed for the lost ones."""
    path = arm_file()
    other = '\n[[fake.faults]]\nkind = "other_master"\nservo = 2\nat = 0.0\nduration = 100.0\namount = 0.02\n'
    path.write_text(path.read_text(encoding="utf-8") + other, encoding="utf-8")
    (finding,) = [each for each in hil.check(path).findings if each.what == "rate"]
    assert finding.level == "stop" and re.search(r"Another program uses this bus: \d+ packets", finding.fix)
    assert "one_write" not in finding.fix
