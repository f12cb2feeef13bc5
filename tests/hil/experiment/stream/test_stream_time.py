"""Timing of the stream: stalled periods are counted exactly, and an error carries the last samples."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import serial

from hil.config.schema import Config
from hil.drivers.errors import PortLost, TorqueNotOff, WrongSetting
from hil.errors import SafetyStop
from hil.experiment.run import run_experiment
from hil.runs.recording import load_samples
from hil.runs.run_folder import RunFolder
from hil.runs.timing import timing
from tests.support.edits import QUICK
from tests.support.stream.at_sample import at_sample

Arm = Callable[..., Config]


def test_a_stall_costs_the_periods_it_covers_and_no_burst_follows(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    config = arm(QUICK[1])

    def stall() -> None:
        ports[0].clock.wait_until(ports[0].clock.now() + 10.5 / 400)

    run = RunFolder.create(tmp_path / "run", config)
    run_experiment(config, run, config.path, at_sample(900, stall))
    samples = load_samples(run.samples_path, 2)
    kept = timing(samples, 400.0)
    assert kept.missed_ticks == 9
    assert kept.lost_replies == 0
    # The exchange before the stall took a third of a period; later ones stay on the original deadlines.
    sent = samples[samples["time_after_read"] > samples["time_before_write"]]
    assert np.diff(sent["time_before_write"]).min() > 0.15 / 400
    assert np.allclose(np.diff(samples["deadline"]), 1 / 400)
    histogram = json.loads((run.path / "lateness.json").read_text(encoding="utf-8"))
    assert sum(histogram["counts"]) == len(sent)


def test_the_servos_clocks_supply_and_temperature_are_on_file(arm: Arm, tmp_path: Path) -> None:
    config = arm(QUICK[1])
    run = RunFolder.create(tmp_path / "run", config)
    run_experiment(config, run, config.path, lambda _: None)
    samples = load_samples(run.samples_path, 2)
    for name, value in (("supply_voltage", 12.0), ("temperature", 35.0)):
        read = samples[name][np.isfinite(samples[name][:, 0])]
        assert len(read) == pytest.approx(len(samples) / 200, abs=2)
        assert read == pytest.approx(value)
    assert timing(samples, 400.0).servo_clock_ppm == pytest.approx([0.0, 0.0], abs=10.0)


def test_a_lost_port_carries_the_last_samples(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    def pull() -> None:
        def fail(*_: object) -> None:
            raise serial.SerialException("device disconnected")

        ports[0].write = fail

    config = arm()
    with pytest.raises(TorqueNotOff, match="NOT CONFIRMED") as caught:
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, at_sample(900, pull))
    lost: Any = caught.value.__context__
    assert isinstance(lost, PortLost)
    last: Any = caught.value.last_samples  # type: ignore[attr-defined]
    assert len(last) == 100
    assert np.isfinite(last["position"]).all()


def test_a_safety_stop_carries_the_sample_that_passed_the_limit(arm: Arm, tmp_path: Path) -> None:
    config = arm(("[-3.1, 3.1]", "[-0.5, 0.5]"))
    with pytest.raises(SafetyStop) as caught:
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None)
    last: Any = caught.value.last_samples
    assert abs(last["position"][-1, 1]) > 0.5


def test_a_rate_that_the_wire_cannot_carry_is_refused_before_torque(arm: Arm, tmp_path: Path, ports: list[Any]) -> None:
    config = arm(("rate = 400.0", "rate = 1200.0"))
    with pytest.raises(WrongSetting, match=r"1200: the longest exchange takes 0\.9\d ms .* must be below 10\d\d Hz"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None)
    assert not any(servo.torque_enabled for servo in ports[0].bus.servos.values())


def test_a_latency_timer_that_may_not_be_set_is_refused_with_the_command_to_type(
    arm: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    timer = tmp_path / "latency_timer"
    timer.write_text("16")
    monkeypatch.setattr("hil.experiment.run.latency_timer", lambda _: timer)
    monkeypatch.setattr("hil.drivers.port.port.adapter_latency", lambda _: 0.016)
    config = arm()
    with pytest.raises(WrongSetting, match=rf"latency timer is 16 ms.*Type: echo 1 \| sudo tee {timer}"):
        run_experiment(config, RunFolder.create(tmp_path / "run", config), config.path, lambda _: None)


def test_a_person_sees_heat_and_supply(arm: Arm, tmp_path: Path) -> None:
    config = arm(*QUICK)
    run = RunFolder.create(tmp_path / "run", config)
    seen: list[Any] = []
    run_experiment(config, run, config.path, lambda progress: seen.append(progress.state.slow))
    assert 35.0 in [slow.temperature[0] for slow in seen if slow is not None]
