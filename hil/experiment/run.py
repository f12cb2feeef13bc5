"""The experiment on the bus: open, check, arm, stream, and torque off however it ends."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from hil import fakes
from hil.config.schema import Config
from hil.drivers.bus import ServoBus
from hil.drivers.clock import Clock, WallClock
from hil.drivers.errors import DriverError, TorqueNotOff, WrongSetting
from hil.drivers.latency import command_to_set, latency_timer
from hil.errors import ExperimentError, HilError, RunFolderError
from hil.experiment.realtime import real_time
from hil.experiment.servo_limits import servo_limits
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Note, Stream, Watch
from hil.plan.plan import Plan, make_plan
from hil.runs.recording import Recorder
from hil.runs.run_folder import RunFacts, RunFolder, write_json
from hil.runs.timing import lateness_histogram
from hil.setup.servo_session import servo_session

_LAST_SAMPLES = 100
"""How many samples an error carries with it."""


def run_experiment(config: Config, run: RunFolder, shown_path: Path, watch: Watch, plan: Plan | None = None) -> str:
    """Play the configuration's experiment and record it in `run`; the sentence about torque at the end.

    shown_path: the configuration's path as the user wrote it. plan: in place of the one made from `config`.
    Raises HilError and DriverError; once torque was on, the exception carries a note that says whether it is off.
    """
    plan = make_plan(config) if plan is None else plan
    fakes.register()
    with StopRequest() as stop, servo_session(config, run.path) as bus:
        clock = bus.port.clock
        run.event(clock.now(), f"opened {config.port.url} at {config.port.baud} baud")
        _check_rate(config, bus)
        _check_pose(config, bus)
        _write_facts(config, run, plan, bus, shown_path)
        with Recorder(run.samples_path, len(bus.joints), plan.capacity) as recorder:
            stop.check()
            with servo_limits(config, bus, lambda what: run.event(clock.now(), what)):
                _play(config, run, plan, bus, recorder, stop, watch)
            write_json(run.path / "lateness.json", lateness_histogram(recorder.samples))
        torque = str(bus.torque_off_report)
        run.event(clock.now(), torque)
        return torque


def _play(
    config: Config, run: RunFolder, plan: Plan, bus: ServoBus, recorder: Recorder, stop: StopRequest, watch: Watch
) -> None:
    """Torque on, stream, torque off; whatever stops it is kept among the events."""
    clock = bus.port.clock

    def note(what: str) -> None:
        run.event(clock.now(), what)

    try:
        # In this order: what _on_time does takes longer than the watchdog waits.
        with _on_time(clock, note), bus.torque(config.safety.watchdog):
            note(f"torque on, watchdog {config.safety.watchdog:g} s")
            Stream(bus, plan, config, recorder, stop, watch, note).run()
    except BaseException as error:
        if isinstance(error, DriverError | HilError):
            error.last_samples = recorder.samples[-_LAST_SAMPLES:].copy()
        if not isinstance(error, TorqueNotOff):
            error.add_note(str(bus.torque_off_report))
        with suppress(RunFolderError):
            note(f"stopped: {error} {bus.torque_off_report}")
        raise


@contextmanager
def _on_time(clock: Clock, note: Note) -> Iterator[None]:
    """Real-time scheduling and the like while the stream runs on the wall clock; a virtual one is never late."""
    if not isinstance(clock, WallClock):
        yield
        return
    with real_time() as granted:
        note("; ".join(map(str, granted)))
        yield


def _check_rate(config: Config, bus: ServoBus) -> None:
    """What the wire and the adapter make impossible from the outset; `hil check` measures what is possible."""
    rate, wire = config.experiment.rate, bus.prepared.longest
    if wire > 1 / rate:
        raise WrongSetting(
            f"experiment.rate = {rate:g}: the longest exchange takes {wire * 1e3:.2f} ms on the wire alone at "
            f"{bus.port.baud} baud, {1 / wire:.0f} Hz at most. Lower the rate, or raise the baud with `hil setup`."
        )
    file = latency_timer(bus.port.url)
    if file is not None and bus.port.latency + wire > 1 / rate:
        raise WrongSetting(
            f"experiment.rate = {rate:g}: the adapter's latency timer is {bus.port.latency * 1e3:.0f} ms, which leaves "
            f"{1 / (bus.port.latency + wire):.0f} Hz, and it may not be set by this user. Type: {command_to_set(file)}"
        )


def _check_pose(config: Config, bus: ServoBus) -> None:
    """The arm must hang where the configuration says, or zero_ticks, direction or the arm is not as described."""
    for joint, position, rest in zip(bus.joints, bus.read_positions(), config.arm.rest_pose, strict=True):
        if abs(position - rest) > config.arm.rest_tolerance:
            ticks = joint.zero_ticks + round((position - rest) / joint.position_unit)
            raise ExperimentError(
                f"{joint} is at {position:.3f} rad; arm.rest_pose says {rest:.3f} and arm.rest_tolerance allows "
                f"{config.arm.rest_tolerance:g}. Move it there by hand: friction may hold it where it was stopped. "
                f"Only if it is in its rest pose now, set zero_ticks = {ticks}."
            )


def _write_facts(config: Config, run: RunFolder, plan: Plan, bus: ServoBus, shown_path: Path) -> None:
    facts = RunFacts(
        config=str(shown_path),
        command_to_sample=bus.prepared.command_to_sample,
        position_step=[joint.servo.position_unit for joint in bus.joints],
        segments=[segment.role for segment in plan.segments],
    )
    run.write_facts(facts, plan)
