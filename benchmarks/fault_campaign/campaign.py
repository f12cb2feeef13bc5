"""Executes injections: runs the complete command in this process, on a virtual arm behind a man in the middle."""

import contextlib
import io
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import serial
from numpy.typing import NDArray

from benchmarks.fault_campaign import arms
from benchmarks.fault_campaign.arms import PERIOD_S, Setting
from benchmarks.fault_campaign.attack import Kind
from benchmarks.fault_campaign.draw import Drawn, draw
from benchmarks.fault_campaign.judge import Story, Verdict, describe, judge
from benchmarks.fault_campaign.middle import Middle, Traffic
from benchmarks.fault_campaign.protocol_campaign import Bench
from benchmarks.fault_campaign.touch import Killed
from benchmarks.fault_campaign.witness import Witness
from benchmarks.spatial.remembered import remembered
from hil.cli.app import main
from hil.config.schema import Config, parse_config
from hil.dry_run.ensemble import prior_ensemble
from hil.dry_run.stopping_distance import stopping_distance
from hil.errors import HilError
from hil.estimator.chain.excitation.fourier_path import design_path
from hil.estimator.excitation.multisine import design_multisine
from hil.plan import chain_plan
from hil.plan import plan as plan_module
from hil.plan.plan import make_plan
from hil.plan.stabiliser import must_balance
from hil.runs.recording import load_samples
from hil.setup import bus_rate

AFTER_S = 0.5
"""Time for which the arm is observed after the program has ended [s]."""

BALANCE_S = 1.2
"""Duration of the last part of a run, in which an upright arm is balanced before its torque is cut [s]."""

Document = dict[str, Any]
STATE = "XDG_STATE_HOME"
FREE = frozenset({"Goal Position", "Registered Instruction"})
"""Registers that a servo writes itself, independently of any program."""

_LIMITS_LEFT = frozenset({Kind.KILLED, Kind.LOWERED_LIMIT})
"""If these two faults occur together, the next start finds the limit set by the other program, and the start after that
finds the limit that the killed run left behind.
"""

_PACKAGE = "benchmarks.fault_campaign"
_ARMS = (1, 12)
"""Numbers of arms for which stopping is simulated. The second number is used if the overshoot exceeds the prediction
for the first.
"""

_CHECKED_CYCLES = 8
"""Cycles per mode in the next start's `hil check`, which only has to restore settings here."""


class DoesNotRun(Exception):
    """A configuration fails at this rate even without faults, so it cannot be tested."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of one injection.

    not_restored: registers that differ from their earlier values even after the next start. unreadable: whether the run
    left neither an expected message nor a readable recording.
    """

    setting: Setting
    drawn: Drawn
    verdict: Verdict
    beyond_limit: bool
    unreadable: bool
    not_restored: tuple[str, ...]
    code: int | None
    text: str

    @property
    def is_good(self) -> bool:
        bad = self.verdict.unsafe or self.beyond_limit or self.unreadable or self.not_restored
        return not (bad or self.verdict.misleading or self.verdict.named is False)

    def __str__(self) -> str:
        flags = ["BEYOND LIMIT"] * self.beyond_limit + ["UNREADABLE"] * self.unreadable
        flags += [f"NOT RESTORED {', '.join(self.not_restored)}"] * bool(self.not_restored)
        head = (
            f"{self.setting.name} {self.setting.rate} Hz: {self.drawn}: {', '.join([describe(self.verdict), *flags])}"
        )
        return f"{head}\n    exit {self.code}: {self.text.strip()[-700:]}"


@dataclass(frozen=True)
class Ready:
    """A configuration at one rate, and its run without faults."""

    setting: Setting
    path: Path
    config: Config
    undisturbed: Story
    not_restored: tuple[str, ...] = ()


@cache
def prepare(
    setting: Setting, period: float = PERIOD_S, make_document: Callable[[Setting, float], Document] = arms.make_document
) -> Ready:
    """Run the configuration once without faults. Raises DoesNotRun if that fails."""
    if _PACKAGE not in serial.protocol_handler_packages:
        serial.protocol_handler_packages.append(_PACKAGE)
    folder = Path(tempfile.mkdtemp(prefix="campaign-"))
    path = folder / f"{setting.name}.toml"
    path.write_text(arms.dump(make_document(setting, period)), encoding="utf-8")
    config = parse_config(path.read_text(encoding="utf-8"), path)
    ready = Ready(setting, path, config, Story(np.empty(0), None, 0.0, None, ""))  # type: ignore[arg-type]
    story, _, changed = play(ready, Drawn((), ()), 0)
    if story.code != 0:
        raise DoesNotRun(f"{setting.name} at {setting.rate} Hz does not run undisturbed: {story.text.strip()}")
    return Ready(setting, path, config, story, changed)


def inject(setting: Setting, seed: int, period: float = PERIOD_S) -> Outcome:
    """Draw faults and inject them into one run."""
    ready = prepare(setting, period)
    ended = ready.undisturbed.ended
    balances = ended - BALANCE_S if must_balance(ready.config) else None
    drawn = draw(f"{setting.name} {setting.rate} {seed}", ended, [j.id for j in ready.config.joints], balances)
    return inject_drawn(ready, drawn, seed)


def inject_drawn(ready: Ready, drawn: Drawn, seed: int) -> Outcome:
    """Inject these faults into one run."""
    story, readable, changed = play(ready, drawn, seed)
    verdict = judge(ready.config, drawn, story, ready.undisturbed)
    beyond = bool((verdict.beyond > 0).any()) and not _is_foreseen(ready, verdict)
    killed = any(each.kind == Kind.KILLED for each in drawn.attacks)
    unreadable = not readable or (not killed and (story.code is None or (story.code != 0 and not story.text.strip())))
    return Outcome(ready.setting, drawn, verdict, beyond, unreadable, changed, story.code, story.text)


def play(ready: Ready, drawn: Drawn, seed: int) -> tuple[Story, bool, tuple[str, ...]]:
    """Run `hil record` once; return its Story, whether the recording is readable, and which registers have changed."""
    witnesses: list[Witness] = []
    before: dict[int, dict[str, int]] = {}

    def opened(port: Middle) -> None:
        witnesses.append(Witness(port.bus))
        before.update(_registers(port))
        port.attack(drawn.attacks, seed)
        port.bus.faults.add(*drawn.faults)

    assert ready.config.fake is not None
    Bench.lay(ready.config.fake, opened)
    with tempfile.TemporaryDirectory() as name, _environment(Path(name) / "state"), _quick(), _signals_ignored():
        folder = Path(name) / "run"
        code, text = _command("record", str(ready.path), "--out", str(folder))
        port = Bench.port
        if port is None:  # the command ended before it opened the port
            return Story(np.empty(0), Traffic(), 0.0, code, text), True, ()
        port.over = True
        if not (finds_limits := {each.kind for each in drawn.attacks} >= _LIMITS_LEFT):
            port.undo()
        ended = port.clock.now()
        port.bus.faults.clear()
        port.clock.wait_until(ended + AFTER_S)
        port.bus.advance(port.clock.now())
        if finds_limits:
            port.dead = False
            port.close()
            _command("check", str(ready.path))
            port.undo()
        changed = _changed(before, port)
        readable = _is_readable(folder, len(ready.config.joints))
        if changed:
            port.dead = False
            port.close()
            _command("check", str(ready.path))
            changed = _changed(before, port)
    return Story(witnesses[0].record(), port.traffic, ended, code, text), readable, changed


def _command(*arguments: str) -> tuple[int | None, str]:
    """Run a command; return its exit code and output. The code is None after an unexpected exception."""
    said = io.StringIO()
    kept, sys.argv = sys.argv, ["hil", *arguments]
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            main()
    except SystemExit as ended:
        return int(ended.code or 0), said.getvalue()
    except Killed:
        return None, said.getvalue()
    except BaseException:
        return None, f"{said.getvalue()}\n{traceback.format_exc()}"
    finally:
        sys.argv = kept
    return None, said.getvalue()


def _is_readable(folder: Path, joints: int) -> bool:
    path = folder / "samples.npy"
    if not path.exists():
        return True
    try:
        load_samples(path, joints)
    except HilError:
        return False
    return True


def _registers(port: Middle) -> dict[int, dict[str, int]]:
    return {
        number: {
            register.name: servo.memory.value(register.name)
            for register in servo.model.registers.values()
            if register.writable and register.name not in FREE
        }
        for number, servo in enumerate(port.bus._servos)
    }


def _changed(before: Mapping[int, Mapping[str, int]], port: Middle) -> tuple[str, ...]:
    after = _registers(port)
    return tuple(
        f"{name} of servo {number + 1}: {value} -> {after[number][name]}"
        for number, registers in before.items()
        for name, value in registers.items()
        if after[number][name] != value
    )


@cache
def _allowed_by(path: Path, arms: int) -> NDArray[np.float64]:
    """Largest overshoot of the position limits that the dry run predicts for this number of arms (joints,) [rad]."""
    text = path.read_text(encoding="utf-8")
    config = parse_config(text, path)
    if config.arm.link_lengths is None:
        assert config.fake is not None and config.fake.arm is not None
        lengths = [link.length for link in config.fake.arm.links]
        config = config.model_copy(update={"arm": config.arm.model_copy(update={"link_lengths": lengths})})
    fastest = np.array([joint.velocity_limit for joint in config.joints])
    ensemble = prior_ensemble(config, max(_ARMS)).first(arms)
    foreseen = stopping_distance(config, make_plan(config), ensemble, fastest)
    return np.asarray(np.max([*foreseen.planned.values(), *foreseen.passed.values()], axis=0))


def _is_foreseen(ready: Ready, verdict: Verdict) -> bool:
    """Whether the dry run predicts an overshoot as large as this one."""
    return any(bool((verdict.beyond <= _allowed_by(ready.path, arms)).all()) for arms in _ARMS)


_designed, _designed_path = remembered(design_multisine), remembered(design_path)


@contextlib.contextmanager
def _quick() -> Iterator[None]:
    """Save time: cache waves and paths, whose design takes as long as a run, and measure the bus only briefly."""
    with (
        mock.patch.object(plan_module, "design_multisine", _designed),
        mock.patch.object(chain_plan, "design_path", _designed_path),
        mock.patch.object(bus_rate, "CYCLES", _CHECKED_CYCLES),
    ):
        yield


@contextlib.contextmanager
def _environment(state: Path) -> Iterator[None]:
    """Redirect the program's persistent state to a temporary folder."""
    kept = os.environ.get(STATE)
    os.environ[STATE] = str(state)
    try:
        yield
    finally:
        os.environ.pop(STATE)
        if kept is not None:
            os.environ[STATE] = kept


@contextlib.contextmanager
def _signals_ignored() -> Iterator[None]:
    """Ignore signals outside the experiment, so that they do not end the campaign."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    kept = {number: signal.signal(number, signal.SIG_IGN) for number in numbers}
    try:
        yield
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
