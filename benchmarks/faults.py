"""The fault campaign: every fault of the fake bus, and some of the program's own, in every phase of the experiment.

    python benchmarks/faults.py [--json] [--seeds N] [--jobs N]

All in virtual time on the realistic fake arm with position limits 0.15 rad and velocity limits 30 % beyond its
undisturbed motion. After each run the emulated servos themselves are asked. An injection is

unsafe          torque neither off nor stopped by the watchdog, or current still flowing 100 ms after the fault (after
                the guard's last look where no single sample shows it: a joint held, a sign turned, lost packets)
beyond_limit    a joint farther beyond its limit than hil.dry_run.stopping_distance predicts for the way in which this
run was stopped unreadable      the recording cannot be read
unnamed         the message does not name the cause

How far the joints went beyond their limits is printed as a share of what was predicted, by way of stopping.
"""

import argparse
import json
import os
import re
import signal
import tempfile
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import serial

from hil.config.schema import Config, parse_config
from hil.dry_run.ensemble import Ensemble, prior_ensemble
from hil.dry_run.stopping_distance import LONGEST_S, Stopping, Way, beyond_when_passed, stopping_distance
from hil.errors import Cause, HilError, SafetyStop
from hil.experiment.run import run_experiment
from hil.fakes.bus.faults import Fault, FaultKind
from hil.plan.plan import Plan, make_plan
from hil.runs.recording import Phase, load_samples
from hil.runs.run_folder import RunFolder

CONFIG = Path(__file__).parents[1] / "configs" / "fake_two_link.toml"
PRIOR = """[arm.prior]
spread = 0.1
rough_spread = 0.1
link_mass = [0.180, 0.200]
link_centre = [0.081, 0.112]
link_inertia = [7.0e-4, 2.9e-4]
armature = [0.010, 0.010]
viscous = [0.045, 0.040]
coulomb = [0.055, 0.050]
"""
DEADLINE_S = 0.1
BEFORE, AFTER, BRAKING = "before torque", "torque off", "braking"
PASSED = "passed, "
PHASES = (BEFORE, "rest", "ramp in", "settling", "used period", "ramp out", "coming to rest", AFTER, BRAKING)
OWN = ("wrong_sign", "torque_taken", "stall", "exception", "SIGINT", "SIGTERM", "SIGHUP", "SIGINT twice")
GRADUAL = {"wrong_sign", "torque_taken", FaultKind.STUCK_JOINT, FaultKind.LOST_REPLY, FaultKind.CORRUPTED_REPLY}
GRADUAL |= {FaultKind.TRUNCATED_REPLY, FaultKind.DUPLICATED_REPLY, FaultKind.LATE_REPLY, FaultKind.NOISE}
GRADUAL |= {FaultKind.LOST_INSTRUCTION, FaultKind.CORRUPTED_INSTRUCTION, FaultKind.ENCODER_JUMP}

OFF_PLAN = {"wrong_sign", "torque_taken", FaultKind.STUCK_JOINT}
"""After these the arm does not move as planned, so it may pass a limit at any speed up to its own limit."""

_SILENT = (
    r"missed \d+ replies|does not answer|failed|NOT CONFIRMED|reads back|refused|carries|alert|moved by|watchdogs act"
)
_LIMIT = r"|outside its position limit|velocity limit|seems to have moved|rest_pose|changes by|moves before the start"
NAMED: dict[str, str] = {
    **dict.fromkeys(FaultKind, _SILENT + _LIMIT),
    FaultKind.OVERHEATING: r"overheating|degrees C|missed \d+ replies",
    FaultKind.OVERLOAD: r"overload",
    FaultKind.LOW_VOLTAGE: r"input voltage| V; safety",
    FaultKind.ENCODER_JUMP: r"seems to have moved|outside its position limit|rest_pose|moves before the start",
    FaultKind.STUCK_JOINT: r"stuck|changes by|outside its position limit|velocity limit",
    FaultKind.CABLE_PULLED: r"Port .* failed|Cannot open|NOT CONFIRMED",
    "wrong_sign": r"against its command|outside its position limit|velocity limit|changes by",
    "torque_taken": r"carries|changes by|stuck|outside its position limit|against its command",
    "stall": r"carries|deadlines in a row|passed between two commands|does not answer",
    "exception": r"injected",
    "SIGINT": r"Ctrl-C",
    "SIGINT twice": r"Ctrl-C",
    "SIGTERM": r"SIGTERM",
    "SIGHUP": r"SIGHUP",
}


@dataclass
class Spy:
    """Stands between bus and plant: when current last flowed, how far the joints went, and a motor turned round."""

    live_until: float = 0.0
    low: list[float] = field(default_factory=lambda: [np.inf, np.inf])
    high: list[float] = field(default_factory=lambda: [-np.inf, -np.inf])
    turned: int | None = None
    tripped: bool = False
    """A watchdog has acted."""
    over: bool = False
    """The run has ended: nothing is injected any more."""


@dataclass(frozen=True)
class Outcome:
    """seen, predicted: way beyond the limits (joints,) [rad], negative within them; way: how the run was stopped."""

    fault: str
    phase: str
    unsafe: bool
    unreadable: bool
    unnamed: bool
    message: str
    way: str
    seen: np.ndarray
    predicted: np.ndarray

    @property
    def beyond(self) -> bool:
        return bool((self.seen > self.predicted).any())


@dataclass(frozen=True)
class Campaign:
    """The arm under test, what it plays, its undisturbed timetable, and how far it may go beyond its limits."""

    config: Config
    plan: Plan
    arms: Ensemble
    windows: dict[str, tuple[float, float]]
    stopping: Stopping


def prepare() -> Campaign:
    """Run once undisturbed: the timetable, limits close to the motion, the stopping distances by simulation."""
    config = short_config(CONFIG.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        _, _, samples, _ = play(config, make_plan(config), Path(folder), lambda port, spy: None)
    config = short_config(_with_close_limits(CONFIG.read_text(encoding="utf-8"), samples))
    plan = make_plan(config)
    with tempfile.TemporaryDirectory() as folder:
        error, port, samples, _ = play(config, plan, Path(folder), lambda port, spy: None)
    assert error is None, error
    fastest = np.array([joint.velocity_limit for joint in config.joints])
    arms = prior_ensemble(config, 16)
    stopping = stopping_distance(config, plan, arms, fastest)
    return Campaign(config, plan, arms, _windows(samples, port.clock.now()), stopping)


def _with_close_limits(text: str, samples: np.ndarray) -> str:
    """Position limits 0.15 rad, velocity limits 30 % beyond the undisturbed motion."""
    low, high = samples["position"].min(axis=0) - 0.15, samples["position"].max(axis=0) + 0.15
    fastest = 1.3 * np.abs(samples["velocity"]).max(axis=0)
    for joint, (limit, velocity) in enumerate((("[-4.2, 1.06]", "15.0"), ("[-3.1, 3.1]", "20.0"))):
        text = text.replace(limit, f"[{low[joint]:.3f}, {high[joint]:.3f}]", 1)
        text = text.replace(f"velocity_limit = {velocity}", f"velocity_limit = {fastest[joint]:.2f}", 1)
    return text


def short_config(text: str) -> Config:
    """The arm of this TOML text with an experiment of some four seconds."""
    for old, new in (
        ("rate = 400.0 ", "rate = 200.0 "),
        ("period = 10.0 ", "period = 1.0 "),
        ("band = [0.1, 5.0]", "band = [1.0, 6.0]"),
        ("ramp = 1.0 ", "held_out = false\nsettle_within = 0.05\nrest = 0.1\nramp = 0.2 "),
        ("[experiment]\n", f"{PRIOR}\n[experiment]\n"),
        ("[arm]\n", "[arm]\nlink_lengths = [0.147, 0.18]\n"),
    ):
        assert old in text, old
        text = text.replace(old, new, 1)
    return parse_config(text, CONFIG)


def play(
    config: Config, plan: Plan, folder: Path, prepare_port: Callable[[Any, Spy], None]
) -> tuple[BaseException | None, Any, np.ndarray, Spy]:
    """One run; the error it ended with, the port, the samples (None where unreadable) and what the spy saw."""
    run = RunFolder.create(folder / "run", config)
    ports: list[Any] = []
    spy = Spy()
    opened = serial.serial_for_url

    def open_port(*args: Any, **kwargs: Any) -> Any:
        port = opened(*args, **kwargs)
        ports.append(port)
        port.bus.plant = SpiedPlant(port.bus.plant, spy)
        for servo in port.bus.servos.values():
            servo.trip_watchdog = _told(spy, servo.trip_watchdog)
        prepare_port(port, spy)
        return port

    error: BaseException | None = None
    serial.serial_for_url = open_port
    try:
        # The fake describes itself from the text under test, limits aside.
        run_experiment(config, run, CONFIG, lambda _: None, plan)
    except Exception as caught:
        error = caught
    finally:
        spy.over = True
        serial.serial_for_url = opened
    samples = load_samples(run.samples_path, 2) if run.samples_path.exists() else np.empty(0)
    return error, ports[0], samples, spy


class SpiedPlant:
    """A plant that tells a spy what flows and how far it goes; a motor turned round feels the opposite current."""

    def __init__(self, plant: Any, spy: Spy) -> None:
        self._plant = plant
        self._spy = spy
        self.joints = plant.joints
        self.jam = plant.jam

    @property
    def position(self) -> Sequence[float]:
        return self._plant.position

    @property
    def velocity(self) -> Sequence[float]:
        return self._plant.velocity

    @property
    def current(self) -> Sequence[float]:
        return self._turned(self._plant.current)

    def advance(self, until: float, current: Sequence[float]) -> None:
        self._plant.advance(until, self._turned(current))
        spy = self._spy
        if any(current):
            spy.live_until = until
        for joint, angle in enumerate(self._plant.position):
            spy.low[joint] = min(spy.low[joint], angle)
            spy.high[joint] = max(spy.high[joint], angle)

    def _turned(self, current: Sequence[float]) -> list[float]:
        return [-each if joint == self._spy.turned else each for joint, each in enumerate(current)]


def _told(spy: Spy, trip: Callable[[], None]) -> Callable[[], None]:
    def tripping() -> None:
        spy.tripped = True
        trip()

    return tripping


def _windows(samples: np.ndarray, end: float) -> dict[str, tuple[float, float]]:
    """When each phase was, in seconds on the port's clock."""

    def of(chosen: np.ndarray) -> tuple[float, float]:
        rows = samples[chosen]
        return float(rows["time_before_write"][0]), float(rows["time_after_read"][-1])

    phase, period = samples["phase"], samples["period"]
    windows = {
        "rest": of(phase == Phase.REST),
        "ramp in": of(phase == Phase.RAMP_IN),
        "settling": of((phase == Phase.PERIODIC) & (period == 0)),
        "used period": of((phase == Phase.PERIODIC) & (period > 0)),
        "ramp out": of(phase == Phase.RAMP_OUT),
        "coming to rest": of(phase == Phase.COMING_TO_REST),
    }
    windows[BEFORE] = (0.0, windows["rest"][0])
    windows[AFTER] = (windows["coming to rest"][1], end)
    windows[BRAKING] = windows["used period"]
    return windows


def inject(campaign: Campaign, kind: str, phase: str, seed: int) -> Outcome:
    """One run with one fault."""
    random = Random(f"{kind} {phase} {seed}")
    start, end = campaign.windows[phase]
    at = random.uniform(start, end)
    happened: list[float] = []

    def prepare_port(port: Any, spy: Spy) -> None:
        if phase == BRAKING:
            _at(port, spy, at, lambda: os.kill(os.getpid(), signal.SIGINT))
        when = at + random.uniform(0.0, 0.06) if phase == BRAKING else at
        happened.append(when)
        if kind in OWN:
            _at(port, spy, when, lambda: _own(kind, port, spy, random))
        else:
            port.bus.faults.add(_fault(kind, when, random))

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for number in handlers:
                signal.signal(number, signal.SIG_IGN)  # a signal outside the experiment must not end the campaign
            error, port, samples, spy = play(campaign.config, campaign.plan, Path(folder), prepare_port)
        except HilError as broken:
            return Outcome(kind, phase, False, True, False, str(broken), "", np.zeros(2), np.zeros(2))
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return _judge(campaign, kind, phase, happened[0], error, port, samples, spy)


def _judge(
    campaign: Campaign,
    kind: str,
    phase: str,
    when: float,
    error: BaseException | None,
    port: Any,
    samples: np.ndarray,
    spy: Spy,
) -> Outcome:
    port.clock.wait_until(port.clock.now() + LONGEST_S)
    servos = port.bus.servos.values()
    stopped = all(not servo.torque_enabled or servo.watchdog_tripped for servo in servos)
    text = "" if error is None else "\n".join(traceback.format_exception(error))
    unsafe = not stopped
    if error is not None:
        looked = samples[samples["phase"] != Phase.BRAKING] if len(samples) else samples
        last_look = float(looked["time_after_read"][-1]) if len(looked) else 0.0
        since = max(when, last_look) if kind in GRADUAL or phase == BRAKING else when
        unsafe |= spy.live_until - since > DEADLINE_S
    limits = np.array([joint.position_limit for joint in campaign.config.joints])
    beyond = np.maximum(limits[:, 0] - spy.low, np.array(spy.high) - limits[:, 1])
    named = error is None or bool(re.search(NAMED[kind], text)) or (phase == BRAKING and "Ctrl-C" in text)
    unreadable = spy.live_until > 0 and not len(samples)
    started = samples if phase == BRAKING or not len(samples) else samples[samples["phase"] != Phase.BRAKING]
    way, predicted = _way(campaign, kind, error, samples, spy)
    if way.startswith(PASSED) and (beyond > 0).any():
        predicted = _from_there(campaign, started)[Way(way.removeprefix(PASSED))]
    return Outcome(kind, phase, unsafe, unreadable, not named, text, way, beyond, predicted)


def _way(
    campaign: Campaign, kind: str, error: BaseException | None, samples: np.ndarray, spy: Spy
) -> tuple[str, np.ndarray]:
    """How the run was stopped, and how far beyond the limits that may lead at most (joints,) [rad]."""
    if error is None:
        return "ran on", np.zeros(2)
    braked = bool(len(samples)) and bool((samples["phase"] == Phase.BRAKING).any())
    if kind not in OFF_PLAN and not _passed_a_limit(error):
        tripped = Way.SILENT_BRAKE if braked else Way.SILENT
        way = tripped if spy.tripped else Way.BRAKED if braked else Way.CUT
        return f"planned, {way}", campaign.stopping.planned[way]
    way = Way.REVERSED if braked and kind == "wrong_sign" else Way.BRAKED if braked else Way.CUT
    return f"{PASSED}{way}", campaign.stopping.passed[way]


def _from_there(campaign: Campaign, samples: np.ndarray) -> dict[Way, np.ndarray]:
    """From where the arm was at the last of these samples, at the speeds of the tenth of a second before it."""
    seen = samples[~samples["missing"].any(axis=1)]
    latest = seen[seen["deadline"] > seen["deadline"][-1] - 0.1]
    speeds = np.abs(latest["velocity"]).max(axis=0)
    return beyond_when_passed(campaign.config, campaign.plan, campaign.arms, speeds, latest["position"][-1])


def _passed_a_limit(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, SafetyStop) and error.cause in {Cause.POSITION, Cause.VELOCITY}:
            return True
        error = error.__context__
    return False


def _at(port: Any, spy: Spy, when: float, action: Callable[[], None]) -> None:
    """Do it when the port's clock passes `when`, unless the run is over."""
    call_at(port, when, lambda: None if spy.over else action())


def call_at(port: Any, when: float, action: Callable[[], None]) -> None:
    """Do it once, in the first wait that ends after `when` on the port's clock."""
    clock = port.clock
    wait = clock.wait_until
    todo = [action]

    def waiting(deadline: float) -> None:
        wait(deadline)
        if todo and clock.now() >= when:
            todo.pop()()

    clock.wait_until = waiting


def _fault(kind: str, at: float, random: Random) -> Fault:
    servo = random.choice((1, 2))
    match kind:
        case FaultKind.CABLE_PULLED:
            return Fault(kind=kind, at=at)
        case FaultKind.ENCODER_JUMP:
            return Fault(kind=kind, at=at, servo=servo, amount=random.choice((-1, 1)) * random.choice((200, 512, 2048)))
        case FaultKind.SILENT_SERVO | FaultKind.REBOOT | FaultKind.OVERHEATING | FaultKind.OVERLOAD:
            return Fault(kind=kind, at=at, servo=servo)
        case FaultKind.LOW_VOLTAGE | FaultKind.STUCK_JOINT:
            return Fault(kind=kind, at=at, servo=servo)
    chance, duration = random.choice(((0.05, 1.0), (0.5, 0.2), (1.0, 0.05), (1.0, 3.0)))
    return Fault(kind=kind, at=at, servo=random.choice((None, servo)), probability=chance, duration=duration)


def _own(kind: str, port: Any, spy: Spy, random: Random) -> None:
    if kind == "wrong_sign":
        spy.turned = random.choice((0, 1))
    elif kind == "torque_taken":
        port.bus.servos[random.choice((1, 2))].write(64, b"\x00")
    elif kind == "stall":
        port.clock._now += random.choice((0.15, 0.3, 1.0))
    elif kind == "exception":
        raise ZeroDivisionError("injected")
    else:
        number = signal.Signals[kind.removesuffix(" twice")]
        os.kill(os.getpid(), number)
        if kind.endswith("twice"):
            _at(port, spy, port.clock.now() + random.uniform(0.0, 0.05), lambda: os.kill(os.getpid(), number))


def kinds() -> list[str]:
    return [*map(str, FaultKind), *OWN]


def campaign_of(seeds: int, jobs: int) -> list[Outcome]:
    """Every fault in every phase, `seeds` times each, in `jobs` processes."""
    campaign = prepare()
    every = [(kind, phase, seed) for seed in range(seeds) for phase in PHASES for kind in kinds()]
    with ProcessPoolExecutor(jobs) as processes:
        return list(processes.map(inject, [campaign] * len(every), *zip(*every, strict=True), chunksize=8))


def shares_of_predicted(outcomes: list[Outcome]) -> dict[str, tuple[int, np.ndarray]]:
    """By way of stopping: stops, and for each joint beyond its limit its way there over the predicted one."""
    shares: dict[str, tuple[int, np.ndarray]] = {}
    for way in sorted({each.way for each in outcomes}):
        chosen = [each for each in outcomes if each.way == way]
        seen, predicted = np.array([each.seen for each in chosen]), np.array([each.predicted for each in chosen])
        beyond = seen > 0
        with np.errstate(divide="ignore"):
            shares[way] = len(chosen), seen[beyond] / predicted[beyond]
    return shares


def main() -> None:
    from machine import machine

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--seeds", type=int, default=14)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--show", action="store_true", help="print every outcome that is not as it should be")
    options = parser.parse_args()
    outcomes = campaign_of(options.seeds, options.jobs)
    shares = shares_of_predicted(outcomes)
    counted = {
        "injections": len(outcomes),
        "unsafe": sum(each.unsafe for each in outcomes),
        "beyond_limit": sum(each.beyond for each in outcomes),
        "unreadable": sum(each.unreadable for each in outcomes),
        "unnamed": sum(each.unnamed for each in outcomes),
    }
    if options.show:
        for each in outcomes:
            if each.unsafe or each.beyond or each.unreadable or each.unnamed:
                print(each.fault, each.phase, each.unsafe, each.beyond, each.unreadable, each.unnamed, each.way)
                print(each.seen, each.predicted, each.message[-600:])
    if options.json:
        every = np.concatenate([share for _, share in shares.values()])
        print(json.dumps({**counted, "worst_of_predicted": round(float(every.max()), 3)}))
        return
    print(machine())
    for name, value in counted.items():
        print(f"{name:14s} {value}")
    print("\nbeyond a limit: predicted at most [rad], joints seen there, and how far of what was predicted")
    print(f"{'stopped':24s} {'stops':>6s} {'predicted':>14s} {'joints':>7s} {'median':>7s} {'worst':>7s}")
    for way, (stops, share) in shares.items():
        most = np.max([each.predicted for each in outcomes if each.way == way], axis=0)
        told = f"{np.median(share):7.2f} {share.max():7.2f}" if share.size else f"{'-':>7s} {'-':>7s}"
        print(f"{way:24s} {stops:6d} {', '.join(f'{value:.2f}' for value in most):>14s} {share.size:7d} {told}")


if __name__ == "__main__":
    main()
