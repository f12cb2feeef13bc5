"""Run the experiment on the bus: open, check, switch torque on, stream, and always switch torque off."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import floor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil import fakes
from hil.config.schema import Config
from hil.drivers.adapter.latency import WANTED_MS, command_to_set, latency_timer, read_latency_ms
from hil.drivers.bus import ServoBus
from hil.drivers.clock import Clock, WallClock
from hil.drivers.errors import BusShared, DriverError, PortLost, ServoFault, TorqueNotOff, WrongSetting
from hil.drivers.servo import LATE
from hil.drivers.state import State
from hil.dry_run.ensemble import Ensemble
from hil.errors import Cause, ExperimentError, HilError, RunFolderError, SafetyStop, StopRequested, Unheard, symptom_of
from hil.estimator.chain.simulation.rollout import ChainArms
from hil.experiment.guard import MOST_OUTSIDE_RAD
from hil.experiment.model_watch import UNLIKE_ANY_ARM
from hil.experiment.servo_limits import servo_limits
from hil.experiment.stop_request import StopRequest
from hil.experiment.stream import Note, Stream, Watch
from hil.experiment.wrong_description import doubt_spatial_description
from hil.plan.chain_plan import check_clearance, plan_of
from hil.plan.plan import Plan
from hil.plan.stabiliser import must_balance
from hil.rest_pose_hint import rest_pose_hint, within_limits
from hil.runs.background import Background
from hil.runs.event_log import EventLog
from hil.runs.recording import Recorder
from hil.runs.run_folder import RunFacts, RunFolder, write_json
from hil.runs.timing import lateness_histogram
from hil.setup.bus_rate import seldom_read_back
from hil.setup.changed_settings import EXPLAINED, WRITTEN, Settings, changed_settings, may_be_later, settings_now
from hil.setup.lying import from_where_it_lies, moved_without_torque, said_of_the_rest, tolerance_now
from hil.setup.pairs import mirrored_pairs
from hil.setup.realtime import on_time
from hil.setup.session.end_of_session import about_torque, confirmed_later
from hil.setup.session.killed_run import REBOOT_S
from hil.setup.session.servo_session import has_moved, lay_at_start, servo_session, settings_at_start
from hil.setup.unmoved import Lies, has_stirred, refuse_moved, wait_for_rest, where_it_lies

__all__ = ["run_experiment"]

_LAST_SAMPLES = 100
"""Number of latest samples that are attached to an exception."""

_FIRST_S = 3.0
_DESCRIBED = (
    "Since the motion had just begun, check first whether the configuration fits the arm: each joint's "
    "direction, id, torque_constant and wiring."
)
"""Advice if the arm is stopped within `_FIRST_S` [s] of the first goal, unless an earlier run of this session moved it.
"""

_MOST_UNSEEN = 20
"""Number of progress reports that may be queued for the observer (about one second)."""

_REPEAT_S = 0.05
"""Time after which the torque-off command is sent again to a servo that does not answer [s]."""

_PATIENCE_S = 0.2
"""Time for which a finished run waits for the observer [s]."""


def run_experiment(
    config: Config,
    run: RunFolder,
    shown_path: Path,
    watch: Watch,
    plan: Plan | None = None,
    arms: Ensemble | ChainArms | None = None,
) -> str:
    """Run the configured experiment and record it in `run`. Returns a sentence about the final torque state.

    Args:
        config: configuration of the arm.
        run: folder of the recording.
        shown_path: the configuration's path as the user wrote it.
        watch: called with progress reports.
        plan: replaces the plan made from `config`.
        arms: prior knowledge of the arm; by default, from the configuration.

    Raises:
        HilError, DriverError: if torque was switched on, a note on the exception says whether it is off again.
    """
    is_given, plan = plan is not None, plan_of(config) if plan is None else plan
    if config.is_chain and not config.is_fake:
        check_clearance(config, plan)
    fakes.register_for(config.url)
    with StopRequest() as stop, EventLog(run) as log, servo_session(config, run.path) as bus:
        clock = bus.port.clock

        def note(what: str) -> None:
            log.note(clock.now(), what)

        if config.is_chain and not config.is_fake:
            note("spatial arms have not been tested on hardware yet: keep a hand on the power supply's switch")
        note(f"opened {config.port.url} at {config.port.baud} baud")
        _check_rate(config, bus)
        lies = _wait_for_rest(config, bus)
        _check_pose(config, bus)
        if config.is_chain and not is_given:
            config, plan = _from_where_it_lies(config, plan, bus, run, note)
        if seldom := seldom_read_back(bus, bus.prepared, bus.port.off_wire):
            note(seldom)
        run.refuse_lost()
        _write_facts(config, run, plan, bus, shown_path, seldom)
        with Recorder(run.samples_path, len(bus.joints), plan.capacity) as recorder, _watched(clock, watch) as shown:
            run.refuse_lost()  # from now on, the recorder can save the files again
            # Signals are deferred from before torque comes on until the servos' settings are restored.
            with stop.only_noted(), servo_limits(config, bus, note):
                changed = _play(config, plan, bus, recorder, stop, shown, note, arms, lies)
            torque = str(bus.torque_off_report)
            note(torque)
            if changed:
                torque = f"{torque} {changed}"
                note(changed)
            with _with_torque(torque):
                recorder.close()
            try:
                write_json(run.path / "lateness.json", lateness_histogram(recorder.samples))
            except RunFolderError as lost:
                torque = f"{torque} {lost} The recording itself is complete."
        with _with_torque(torque):
            stop.check()  # the recording is kept, but nothing more is run
    return torque


@contextmanager
def _with_torque(torque: str) -> Iterator[None]:
    """Append the torque state to errors from closing the recording, and to stop requests that were deferred
    until then.
    """
    try:
        yield
    except (RunFolderError, StopRequested) as error:
        error.add_note(torque)
        raise


def _play(
    config: Config,
    plan: Plan,
    bus: ServoBus,
    recorder: Recorder,
    stop: StopRequest,
    watch: Watch,
    note: Note,
    arms: Ensemble | ChainArms | None,
    lay: Lies,
) -> str:
    """Switch torque on, stream, switch torque off; whatever stops the stream is logged as an event.

    lay: positions of the servos when the arm's pose was checked.

    Returns sentences about settings that another program changed during the run, and about an arm that does not stay in
    its rest pose without torque; "" if neither happened.
    """
    stream = Stream(bus, plan, config, recorder, stop, watch, note, arms)
    settings: Settings = {}
    try:
        # In this order, because on_time takes longer than the watchdog's timeout.
        with on_time(bus.port.clock) as granted:
            bus.refuse_switched_on()  # rather than blame the motion that this causes on a hand or a horn
            settings = _check_unchanged(bus)
            refuse_moved(lay, where_it_lies(bus), bus)
            stream.begins_at(bus.read_positions())
            with bus.torque(config.safety.watchdog):
                if granted:
                    note("; ".join(map(str, granted)))
                note(f"torque on, watchdog {config.safety.watchdog:g} s")
                stream.run()
    except BaseException as error:
        _explain_alert(bus, stream.state, error)
        _explain_by_settings(bus, settings, error, stream.modes_seen_ago)
        if not has_moved():
            doubt_description(error, recorder.samples)
        with suppress(Exception):  # a failing hint must not hide what stopped the arm, or its torque state
            doubt_spatial_description(config, error, recorder.samples, has_moved=has_moved())
        if isinstance(error, DriverError | HilError):
            error.last_samples = recorder.samples[-_LAST_SAMPLES:].copy()
        if not isinstance(error, TorqueNotOff):
            error.add_note(about_torque(bus))
            try:
                moved = _moved_without_torque(config, bus, recorder)
            except DriverError as driven:
                moved = str(driven)
            if moved:
                error.add_note(moved)
        cause = error.__context__ if isinstance(error, TorqueNotOff) else error
        note(f"stopped: {cause or 'end of the run.'} {about_torque(bus)}")
        if isinstance(error, TorqueNotOff):
            _try_again(bus, note)
        if isinstance(cause, SafetyStop) and (who := _why_silent(bus, cause)):
            cause.replace_remedy(who)
            note(who)
        if isinstance(error, TorqueNotOff) and (instead := confirmed_later(bus, error)):
            if isinstance(instead, DriverError | HilError):
                instead.last_samples = error.last_samples
            raise instead from None
        raise
    said = changed_settings(settings, settings_now(bus, settings)), _moved_without_torque(config, bus, recorder)
    return " ".join(each for each in said if each)


def _moved_without_torque(config: Config, bus: ServoBus, recorder: Recorder) -> str:
    """Describe how the arm has moved since the last sample before torque was cut; "" if nothing is known."""
    samples = recorder.samples
    if not len(samples) or bus.torque_off_report is None:
        return ""
    return moved_without_torque(config, bus, samples["position"][-1].tolist())


def _try_again(bus: ServoBus, note: Note) -> None:
    """Keep cutting the torque of servos that did not answer, for as long as a servo takes to boot.

    Their watchdogs, if still armed, have tripped by now, so packets can no longer delay them.
    """
    clock = bus.port.clock
    end = clock.now() + REBOOT_S
    while clock.now() < end:
        clock.wait_until(min(end, clock.now() + _REPEAT_S))
        bus.repeat_torque_off()
    for drive in bus.drives:
        with suppress(DriverError):
            if bus.confirm_later(drive):
                note(f"{drive.title} answers again; {bus.torque_off_report}")


def _why_silent(bus: ServoBus, stop: SafetyStop) -> str:
    """Report late replies that arrived after torque was cut. Otherwise, if no servo was heard, name those that answered
    later: a silent servo hides the replies of the servos after it.
    """
    report = bus.torque_off_report
    if stop.unheard is None or report is None:
        return ""
    if bus.port.late_replies and not bus.port.strangers:
        return LATE
    silent = {joint for joint, _ in report.unconfirmed} | report.later | report.rebooted
    heard = [str(joint) for joint in bus.drives if joint not in silent]
    if stop.unheard is not Unheard.ALL or not silent or not heard:
        return ""
    return (
        f"No servo replied when the arm was stopped. Afterwards, {' and '.join(heard)} answered and "
        f"{' and '.join(map(str, silent))} did not: a silent servo hides the replies of the servos after it. Check its "
        "cable and its supply."
    )


def _explain_alert(bus: ServoBus, state: State | None, error: BaseException) -> None:
    """Ask the servos for the cause of an alert, but only once torque is off: a silent servo delays the answer."""
    stop = error if isinstance(error, SafetyStop) else error.__context__
    if state is None or not isinstance(stop, SafetyStop) or stop.cause is not Cause.ALERT:
        return
    try:
        bus.check_alerts(state)
    except ServoFault as fault:
        stop.args = (str(fault),)
    except DriverError:
        return


def _check_unchanged(bus: ServoBus) -> Settings:
    """Check that the servos' settings have not changed since the session began; return them.

    Raises BusShared if another program has changed any of them.
    """
    before = {each: value for each, value in settings_at_start().items() if each[1] not in WRITTEN}
    now = settings_now(bus)
    if changed := changed_settings(before, now):
        again = " again after the previous run" if bus.has_switched_on else ""
        raise BusShared(f"{changed} Torque has not been switched on{again}. Stop that program, then start again.")
    return now


def _explain_by_settings(bus: ServoBus, before: Settings, error: BaseException, modes_seen_ago: float) -> None:
    """Name settings that another program changed. They are read only once torque is off, because reading takes time.

    Changes that can explain why the run was stopped are named before the error's message. Others, including any that
    may have been made later, are named after it.
    """
    if not isinstance(error, HilError | DriverError | KeyboardInterrupt) or isinstance(error, PortLost):
        return
    stop = error if isinstance(error, SafetyStop) else error.__context__
    now = settings_now(bus, before)
    explained = stop if isinstance(stop, SafetyStop) and stop.cause in EXPLAINED else None
    if explained is not None and (changed := changed_settings(before, now, explained.cause)):
        later = may_be_later(before, now, explained.cause, modes_seen_ago)
        explained.args = (f"{explained} {later}" if later else f"{changed} Symptom: {symptom_of(explained)}.",)
        explained.overruled = True
    elif changed := changed_settings(before, now):
        error.add_note(changed)


def doubt_description(error: BaseException, samples: NDArray[np.void]) -> None:
    """If the guard stopped the arm early in its first motion, name mistakes in the description as a possible cause."""
    stop = error if isinstance(error, SafetyStop) else error.__context__
    if not isinstance(stop, SafetyStop) or stop.overruled:
        return
    driven = np.flatnonzero(samples["goal_current"].any(axis=1))
    is_doubtful = stop.cause is Cause.POSITION or UNLIKE_ANY_ARM in str(stop)
    if is_doubtful and driven.size and np.ptp(samples["time_before_write"][driven[0] :]) < _FIRST_S:
        stop.args = (f"{stop} {_DESCRIBED}",)


@contextmanager
def _watched(clock: Clock, watch: Watch) -> Iterator[Watch]:
    """In real time, call `watch` from a separate thread, so that a blocked terminal cannot delay the stream."""
    if not isinstance(clock, WallClock):
        yield watch
        return
    shown = Background(watch, _MOST_UNSEEN)
    try:
        yield shown.put
    finally:
        shown.close(_PATIENCE_S)


def _wait_for_rest(config: Config, bus: ServoBus) -> Lies:
    """Wait until a swinging arm has come to rest; return the servos' positions.

    Raises ExperimentError if the arm has moved far since the start, or if a spatial arm does not come to rest; and
    BusShared if another program switches torque on.
    """
    bus.refuse_switched_on()
    lay, lies = lay_at_start(), where_it_lies(bus)
    try:
        refuse_moved(lay, lies, bus)
    except ExperimentError:
        _check_unchanged(bus)  # which names another program that shifted the angles
        if config.is_chain and not wait_for_rest(bus):
            _check_pose(config, bus)  # which names the pose to which the arm fell
        raise
    # An upright arm that nobody holds would only fall farther.
    if has_moved() or config.is_chain or (has_stirred(lay, lies) and not must_balance(config)):
        if (moving := wait_for_rest(bus)) and config.is_chain:
            raise ExperimentError(moving)
        lies = where_it_lies(bus)
    return lies


def _check_rate(config: Config, bus: ServoBus) -> None:
    """Refuse a rate that wire time or adapter latency rules out; `hil check` measures what is possible."""
    rate, wire = config.experiment.rate, bus.prepared.longest
    if wire > 1 / rate:
        raise WrongSetting(
            f"experiment.rate = {rate:g}: the longest exchange takes {wire * 1e3:.2f} ms of wire time alone at "
            f"{bus.port.baud} baud, so the rate must be below {floor(1 / wire)} Hz, and the adapter needs time, too. "
            "Set the rate to what `hil check` measures, or raise the baud rate with `hil setup`."
        )
    slowest = bus.port.latency + wire
    if slowest <= 1 / rate:
        return
    file = latency_timer(bus.port.url)
    if file is not None and read_latency_ms(file) > WANTED_MS:
        raise WrongSetting(
            f"experiment.rate = {rate:g}: the adapter's latency timer is {bus.port.latency * 1e3:.0f} ms, which allows "
            f"at most {floor(1 / slowest)} Hz. You do not have permission to change it. Type: {command_to_set(file)}"
        )
    if bus.port.latency_measured:
        raise WrongSetting(
            f"experiment.rate = {rate:g}: even the fastest of many replies arrives {bus.port.latency * 1e3:.0f} ms "
            f"later than its transmission time explains. This latency allows at most {floor(1 / slowest)} Hz. If other "
            "programs keep this computer busy, close them and start again. Otherwise the adapter is slow: lower the "
            "rate, or use a wired adapter with a short latency, such as a U2D2."
        )


def _check_pose(config: Config, bus: ServoBus) -> None:
    """Check that the arm is in its rest pose and that the servos of one joint agree; otherwise zero_ticks, direction or
    the arm's description is wrong.

    After an earlier run of the session, twice the tolerance is allowed, since friction may hold the arm away from its
    rest pose.
    """
    if has_moved():
        _check_inside(config, bus)
    tolerance = tolerance_now(config)
    or_there = " If the arm lies there without torque, set arm.rest_pose to this pose." if config.is_chain else ""
    for joint, position, rest in zip(bus.joints, _positions(config, bus), config.arm.rest_pose, strict=True):
        if abs(position - rest) > tolerance:
            ticks = joint.zero_ticks + round((position - rest) / joint.position_unit)
            raise ExperimentError(
                f"{joint} is at {position:.3f} rad; arm.rest_pose is {rest:.3f} and arm.rest_tolerance allows "
                f"{tolerance:g}. {rest_pose_hint(position, rest, tolerance, ticks)}{or_there}"
            )
    if not has_moved() and (mirrored := list(mirrored_pairs(config, bus))):
        raise WrongSetting(" ".join(mirrored))


def _positions(config: Config, bus: ServoBus) -> list[float]:
    """Return each joint's angle [rad], shifted by whole turns to lie within the position limits if possible."""
    read = zip(bus.read_positions(), config.joints, strict=True)
    return [within_limits(position, joint.position_limit) for position, joint in read]


def _from_where_it_lies(config: Config, plan: Plan, bus: ServoBus, run: RunFolder, note: Note) -> tuple[Config, Plan]:
    """If a spatial arm is not exactly in its rest pose, plan its motion from where it lies, and save that pose for the
    estimation.
    """
    lies = from_where_it_lies(config, bus.read_positions())
    if lies is config:
        return config, plan
    note(said_of_the_rest(config, lies))
    plan = plan_of(lies)
    if not config.is_fake:
        check_clearance(lies, plan)
    run.write_played(lies)
    return lies, plan


def _check_inside(config: Config, bus: ServoBus) -> None:
    """Refuse an arm that the previous run left far beyond its limits, such as an upright arm that fell when torque was
    cut.
    """
    for joint, position, limited in zip(bus.joints, _positions(config, bus), config.joints, strict=True):
        low, high = limited.position_limit
        if not low - MOST_OUTSIDE_RAD <= position <= high + MOST_OUTSIDE_RAD:
            raise ExperimentError(
                f"{joint} is at {position:.3f} rad, where the stop of the previous run left it, outside its position "
                f"limit [{low:g}, {high:g}]. Move it back to arm.rest_pose by hand, then start again."
            )


def _write_facts(config: Config, run: RunFolder, plan: Plan, bus: ServoBus, shown_path: Path, seldom: str) -> None:
    facts = RunFacts(
        config=str(shown_path),
        command_to_sample=bus.prepared.command_to_sample,
        position_step=[joint.servo.position_unit for joint in bus.joints],
        segments=[segment.role for segment in plan.segments],
        monitoring=seldom,
    )
    run.write_facts(facts, plan)
