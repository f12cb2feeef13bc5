"""Stop requests are deferred while servos may have torque, and kept until the outermost block is left."""

import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.errors import StopRequested
from hil.experiment.run import run_experiment
from hil.experiment.stop_request import StopRequest
from hil.plan.plan import make_plan
from hil.runs.run_folder import RunFolder

Arm = Callable[..., Config]


def send(number: signal.Signals = signal.SIGINT) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_only_noted_under_torque_and_raised_after_it(number: signal.Signals) -> None:
    after = []
    with pytest.raises(StopRequested, match=r"Ctrl-C|SIGTERM|SIGHUP"), StopRequest() as stop:
        with stop.only_noted():
            send(number)
            after.append("torque is cut undisturbed")
        stop.check()
    assert after


def test_without_torque_a_signal_ends_the_work_at_once() -> None:
    with pytest.raises(StopRequested), StopRequest():
        send()
        raise AssertionError("it went on")


def test_a_request_that_somebody_swallowed_forbids_the_next_experiment() -> None:
    with pytest.raises(StopRequested), StopRequest():
        with suppress(StopRequested):
            send()
        with StopRequest() as inner, inner.only_noted():
            raise AssertionError("the arm moves")


def test_handlers_are_the_former_ones_after_the_outermost_block_and_a_second_signal_insists() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(StopRequested), StopRequest() as stop:
        with StopRequest() as inner:
            assert inner is stop
        assert signal.getsignal(signal.SIGTERM) != before, "the outer block is still active"
        with stop.only_noted():
            send(signal.SIGTERM)
            assert not stop.insisted
            send()
            assert stop.insisted
    assert signal.getsignal(signal.SIGTERM) == before


def test_in_another_thread_there_is_never_a_request() -> None:
    seen: list[BaseException | None] = []

    def work() -> None:
        try:
            with StopRequest() as stop, stop.only_noted():
                stop.check()
            seen.append(None)
        except BaseException as error:
            seen.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [None]


def test_a_signal_while_torque_is_being_cut_is_not_lost(
    arm: Arm, tmp_path: Path, ports: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise, the next step of a pilot would move the arm."""
    config = arm()
    cut = ServoBus.torque_off

    def interrupted(bus: ServoBus) -> Any:
        send(signal.SIGTERM)
        return cut(bus)

    monkeypatch.setattr(ServoBus, "torque_off", interrupted)
    run = RunFolder.create(tmp_path / "run", config)
    with pytest.raises(StopRequested, match="SIGTERM") as stop:
        run_experiment(config, run, config.path, lambda _: None, make_plan(config).first_segment())
    assert "Torque is off on both servos" in stop.value.__notes__[0]
    assert not any(servo.torque_enabled for servo in ports[0].bus.servos.values())
    assert "Torque is off on both servos" in (run.path / "events.jsonl").read_text(encoding="utf-8")


def test_after_the_torque_is_off_a_signal_ends_the_work_at_once_again() -> None:
    with pytest.raises(StopRequested), StopRequest() as stop:
        for _ in range(2):
            with stop.only_noted():
                pass
        send()
        raise AssertionError("it went on")


def test_while_an_arm_is_lowered_only_a_further_signal_cuts_its_torque() -> None:
    with pytest.raises(StopRequested), StopRequest() as stop, stop.only_noted():
        send()
        stop.check_again(stop.count)
        send()
        with pytest.raises(StopRequested):
            stop.check_again(1)
        stop.check_again(2)
