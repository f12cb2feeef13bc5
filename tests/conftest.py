"""Fixtures: a fake arm with a short experiment, and the ports that a test opened, for inspecting the servos."""

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import serial
from hypothesis import HealthCheck, settings
from threadpoolctl import threadpool_limits

from benchmarks.spatial.remembered import remembered
from hil.config.schema import Config, load_config
from hil.dry_run import stopping_distance
from hil.estimation.settled_estimate import estimate_run
from hil.experiment.run import run_experiment
from hil.plan import chain_plan, plan
from hil.runs.run_folder import RunFolder
from tests.support.edits import replaced
from tests.support.paths import CONFIGS

# The same examples in every run, however busy the machine is. Fixtures used with @given only build what may be shared.
settings.register_profile(
    "repeatable", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
settings.load_profile("repeatable")


@pytest.hookimpl(trylast=True)  # once deselected tests are gone
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Start with the tests that take a minute each, so that no worker is left with one at the end; then take files from
    the first and the second half of the others in turn.

    Of two workers that take whole files, each is then in another part of the code: what one of them compiles, the other
    later finds on disk. Next to each other, both would compile the same loops at the same time.
    """
    files = list(dict.fromkeys(item.path for item in items))
    half = (len(files) + 1) // 2
    turns = {path: 2 * (place % half) + place // half for place, path in enumerate(files)}

    def turn(item: pytest.Item) -> int:
        if item.get_closest_marker("long") is None:
            return turns[item.path]
        return -1 if "chain" in item.nodeid else -2

    items.sort(key=turn)


def pytest_collection_finish() -> None:
    """Exclude what was imported and collected from garbage collection, which otherwise searches it again and again, and
    collect less often: compiling a loop creates a million objects, nearly all of which are still in use.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 50, 50)


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread() -> Iterator[None]:
    """As in `hil.cli.app.main`, which comes too late here: on two cores, two workers would wait for each other."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_disks() -> Iterator[None]:
    """Only a power failure would show the difference, and each call takes a virtual disk several milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _designs_remembered() -> Iterator[None]:
    """Most tests use one of a few multisines or paths, and a design takes as long as a short run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "design_multisine", remembered(plan.design_multisine))
        patch.setattr(chain_plan, "design_path", remembered(chain_plan.design_path))
        yield


@pytest.fixture(scope="session", autouse=True)
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Redirect saved servo settings to a temporary state folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(autouse=True)
def state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state folder for this test only; returns the folder of saved servo settings in it."""
    folder = tmp_path / "state"
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    return folder / "hil" / "servos"


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Every port opened during the test, in order; `.bus.servos` are the emulated servos."""
    opened: list[Any] = []
    open_port = serial.serial_for_url

    def keep(*args: Any, **kwargs: Any) -> Any:
        opened.append(open_port(*args, **kwargs))
        return opened[-1]

    monkeypatch.setattr(serial, "serial_for_url", keep)
    return opened


@pytest.fixture
def arm_file(tmp_path: Path) -> Callable[..., Path]:
    """Writes a file of the ideal fake arm with a 2 s period and the given (old, new) changes; returns its path."""

    def write(*changes: tuple[str, str], base: str = "fake_two_link_ideal") -> Path:
        text = (CONFIGS / f"{base}.toml").read_text(encoding="utf-8")
        short = (("period = 10.0 ", "period = 2.0 "), ("band = [0.1, 5.0]", "band = [0.5, 6.0]"))
        text = replaced(text, *short, *changes)
        path = tmp_path / "arm.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def few_stops(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dry run simulates the stops of two arms instead of sixteen: they take most of its time and have own tests."""
    monkeypatch.setattr(stopping_distance, "_ARMS", 2)


@pytest.fixture
def arm(arm_file: Callable[..., Path]) -> Callable[..., Config]:
    """As `arm_file`, but returns the checked configuration."""
    return lambda *changes, **options: load_config(arm_file(*changes, **options))


def _identify(path: Path, folder: Path) -> Path:
    config = load_config(path)
    run = RunFolder.create(folder, config)
    run_experiment(config, run, path, lambda _: None)
    estimate_run(run)
    return run.path


@pytest.fixture(scope="session")
def identified_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the ideal fake arm with a short period, shared by all tests; read-only."""
    folder = tmp_path_factory.mktemp("identified")
    text = (CONFIGS / "fake_two_link_ideal.toml").read_text(encoding="utf-8")
    text = text.replace("period = 10.0 ", "period = 2.0 ").replace("band = [0.1, 5.0]", "band = [0.5, 6.0]")
    path = folder / "arm.toml"
    path.write_text(text, encoding="utf-8")
    return _identify(path, folder / "run")


@pytest.fixture
def identified(identified_once: Path, tmp_path: Path) -> Path:
    """A copy of that run folder for one test."""
    return Path(shutil.copytree(identified_once, tmp_path / "identified"))
