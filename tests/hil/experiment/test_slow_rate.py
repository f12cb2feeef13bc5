"""At slow rates faults are detected as early as at fast ones: the goals are exchanged again between two samples."""

import math
import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from hil import fakes
from hil.api.check import check
from hil.config.schema import Config, load_config
from hil.drivers.bus import CHECK_S, ServoBus
from hil.errors import Cause, ConfigError, SafetyStop, StopRequested
from hil.experiment.guard import Guard
from hil.experiment.pace import Pace
from hil.experiment.run import run_experiment
from hil.experiment.stream import Progress
from hil.fakes.bus.clock import VirtualClock
from hil.fakes.bus.faults import Fault, FaultKind
from hil.plan.plan import make_plan
from hil.plan.stabiliser import too_slow
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder
from hil.setup.finding import Level
from hil.setup.preflight import check_arm
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

Arm = Callable[..., Config]
Act = Callable[[Progress], None]
RATE = 20.0
TORQUE_OFF = b"\x83\x40\x00\x01\x00"
"""Start of the Sync Write that cuts torque: instruction, address 64, one byte each."""
AT_20_HZ = ("rate = 400.0", "rate = 20.0"), ("band = [0.5, 6.0]", "band = [0.5, 4.0]")


def once_moving(action: Callable[[], Any]) -> Act:
    """Act once in the first period after the ramp."""
    done: list[bool] = []

    def act(progress: Progress) -> None:
        if progress.phase == Phase.PERIODIC and not done:
            done.append(True)
            action()

    return act


def run(config: Config, folder: Path, act: Act) -> np.ndarray:
    folder_of_run = RunFolder.create(folder, config)
    run_experiment(config, folder_of_run, config.path, act, make_plan(config).first_segment())
    return load_samples(folder_of_run.samples_path, 2)


def test_goals_are_exchanged_a_hundred_times_a_second_and_recorded_twenty_times(
    arm: Arm, tmp_path: Path, ports: list[Any]
) -> None:
    times: list[float] = []

    def note_times() -> None:
        port = ports[0]
        write = port.write

        def written(data: bytes) -> Any:
            if port.bus.servos[1].torque_enabled:
                times.append(port.clock.now())
            return write(data)

        port.write = written

    samples = run(arm(*AT_20_HZ), tmp_path / "run", once_moving(note_times))
    assert np.diff(times[:-10]).max() < 1.2 * CHECK_S, "the last ones cut torque"
    assert np.allclose(np.diff(samples["deadline"]), 1 / RATE)
    assert np.allclose(samples["time_before_write"] - samples["deadline"], 0.0, atol=1e-3)
    # The slow registers are read only in samples, which are recorded.
    assert np.count_nonzero(np.isfinite(samples["temperature"][:, 0])) >= len(samples) / RATE - 2


def test_a_slow_adapter_leaves_exchanges_out_and_delays_no_sample(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = arm(*AT_20_HZ, ("adapter_latency_us = 60.0", "adapter_latency_us = 16000.0"))
    monkeypatch.setattr("hil.drivers.port.port.adapter_latency", lambda _: 0.017)
    samples = run(config, tmp_path / "run", lambda _: None)
    assert np.abs(samples["time_before_write"] - samples["deadline"]).max() < 1e-3
    assert not samples["missing"].any()


class SlowOnce:
    """A bus whose exchanges take the given times [s], and 1 ms once these are used up."""

    exchanges_per_sample = 5

    def __init__(self, takes: list[float]) -> None:
        self._takes = takes
        self.port = SimpleNamespace(clock=VirtualClock())
        self.prepared = SimpleNamespace(read_back_at=math.inf, awaited_until=-math.inf)

    def exchange(self, goal: Sequence[float], *, between: bool = False) -> Any:
        clock = self.port.clock
        before = clock.now()
        clock.wait_until(before + (self._takes.pop(0) if between and self._takes else 1e-3))
        return SimpleNamespace(time_before_write=before, time_after_read=clock.now())


@pytest.mark.parametrize(("takes", "counts"), [([0.001, 0.001, 0.033], [3, 4, 4]), ([0.033] * 3, [1, 1, 1])])
def test_a_single_long_exchange_does_not_prevent_the_next_ones(takes: list[float], counts: list[int]) -> None:
    bus = cast("ServoBus", SlowOnce(takes))
    pace = Pace(bus, RATE, cast("Guard", SimpleNamespace(woke_up=lambda *_: None)))
    counted = []
    for _ in counts:
        pace.wait()
        pace.send([0.1])
        counted.append(len(list(pace.between([0.1]))))
    assert counted == counts


@pytest.mark.parametrize(("rate", "count"), [(20.0, 5), (33.0, 4), (60.0, 2), (99.0, 2), (100.0, 1), (400.0, 1)])
def test_exchanges_per_sample(arm: Arm, rate: float, count: int) -> None:
    config = arm(("rate = 400.0", f"rate = {rate}"), ("band = [0.5, 6.0]", "band = [0.5, 4.0]"))
    fakes.register_for(config.url)
    with ServoBus.open(config.bus) as bus:
        assert bus.exchanges_per_sample == count


def stopped(config: Config, folder: Path, ports: list[Any], action: Callable[[Any], None]) -> tuple[SafetyStop, float]:
    """The stop, and the time from the action to the first torque-off [s]."""
    at: list[float] = []
    off: list[float] = []

    def act() -> None:
        port = ports[0]
        at.append(port.clock.now())
        write = port.write

        def written(data: bytes) -> Any:
            if TORQUE_OFF in data:
                off.append(port.clock.now())
            return write(data)

        port.write = written
        action(port)

    with pytest.raises(SafetyStop) as stop:
        run(config, folder, once_moving(act))
    return stop.value, off[0] - at[0]


def test_a_silent_servo_is_found_within_the_time_of_a_fast_rate(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    def silence(port: Any) -> None:
        port.bus.faults.add(Fault(kind=FaultKind.SILENT_SERVO, at=port.bus.time, servo=2, duration=0.035))

    stop, seconds = stopped(arm(*AT_20_HZ), tmp_path / "run", ports, silence)
    assert stop.cause is Cause.MISSING
    assert seconds < 0.045, "two lost replies, each waited for"


def test_lost_torque_is_found_between_two_samples(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    stop, seconds = stopped(arm(*AT_20_HZ), tmp_path / "run", ports, lambda port: port.bus.servos[1].write(64, b"\x00"))
    assert stop.cause in (Cause.TORQUE_OFF, Cause.NOT_FOLLOWING)
    assert seconds < 0.07


def test_a_stop_is_obeyed_between_two_samples_and_the_brake_follows_at_once(
    arm: Arm, tmp_path: Path, ports: list[Any]
) -> None:
    config = arm(*AT_20_HZ)
    folder = RunFolder.create(tmp_path / "run", config)
    at: list[float] = []

    def interrupt() -> None:
        at.append(ports[0].clock.now())
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(StopRequested):
        run_experiment(config, folder, config.path, once_moving(interrupt), make_plan(config).first_segment())
    rows = load_samples(folder.samples_path, 2)
    braked = rows[rows["phase"] == Phase.BRAKING]
    assert len(braked) > 1
    assert braked["time_before_write"][0] - at[0] < CHECK_S + 2e-3
    assert np.diff(braked["time_before_write"]).max() < 1.2 * CHECK_S


def test_a_rate_too_slow_for_the_stabiliser_is_refused_with_the_one_that_suffices(tmp_path: Path) -> None:
    text = (CONFIGS / "fake_inverted.toml").read_text(encoding="utf-8")
    path = tmp_path / "arm.toml"
    path.write_text(replaced(text, ("rate = 400.0", "rate = 20.0"), ("[0.1, 5.0]", "[0.1, 4.0]")), encoding="utf-8")
    config = load_config(path)
    with pytest.raises(ConfigError, match=r"rate = 20 is too low for the stabiliser of joint 'shoulder'.*at least 68"):
        make_plan(config)
    found = [each for each in check_arm(config) if each.where == "stabiliser"]
    assert [each.level for each in found] == [Level.STOP]
    enough = config.model_copy(update={"experiment": config.experiment.model_copy(update={"rate": 68.0})})
    assert too_slow(enough) == ""


@pytest.mark.parametrize(("rate", "wanted"), [(20.0, True), (100.0, False)])
def test_check_refuses_a_rate_at_which_the_pilot_cannot_balance_the_arm(
    tmp_path: Path, rate: float, wanted: bool
) -> None:
    text = (CONFIGS / "first_time.toml").read_text(encoding="utf-8")
    upright = ("zero_ticks = 3072  ", "zero_ticks = 1024  "), ("[-4.2, 1.06]", "[0.4, 2.7]"), ("[-1.57", "[1.57")
    path = tmp_path / "arm.toml"
    slow = (("rate = 400.0", f"rate = {rate}"), ("band = [0.1, 5.0]", "band = [0.1, 4.0]"))
    path.write_text(replaced(text, *upright, *slow), encoding="utf-8")
    found = [each for each in check(path).problems if each.what == "rate"]
    assert [each.where for each in found] == ["experiment"] * wanted
    assert all("rate = 20 is too low to hold joint 'shoulder'" in each.fix for each in found)
