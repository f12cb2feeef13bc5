"""Check for anything that would prevent or stop an experiment, and state how to fix it. Torque stays off."""

from collections.abc import Iterator

from hil import fakes
from hil.clearance.doubts import doubts
from hil.config.schema import Config
from hil.drivers.adapter.latency import FACTORY_MS, WANTED_MS, command_to_set, latency_timer, read_latency_ms
from hil.drivers.bus import ServoBus
from hil.drivers.errors import BusShared, DriverError, PortNotOpened, WrongSetting
from hil.drivers.preparation.prepare import check_quiet
from hil.drivers.preparation.settings import WATCHDOG_TRIPPED
from hil.drivers.torque.held import switched_on
from hil.errors import ConfigError
from hil.estimator.errors import EstimationError
from hil.plan.chain_plan import check_clearance, check_rest_pose, make_chain_plan, missing_path
from hil.plan.find_torque import how_to_find_torque
from hil.plan.stabiliser import too_slow
from hil.setup.bus_rate import check_rate, goals_taken, seldom_as_measured
from hil.setup.finding import Finding, Level
from hil.setup.pairs import mirrored_pairs
from hil.setup.servo_checks import check_servo
from hil.setup.session.others import others_on_the_bus


def check_arm(config: Config) -> Iterator[Finding]:
    """Check port, servos, pose and rate, in this order. A check that cannot be carried out yields a STOP instead of
    raising an exception.
    """
    fakes.register_for(config.url)
    try:
        bus = ServoBus.connect(config.bus)
    except PortNotOpened as error:
        yield Finding(Level.STOP, config.port.url, "port", "cannot be opened", str(error))
        return
    with bus:
        yield Finding(Level.OK, bus.port.url, "port", f"opened at {config.port.baud} baud")
        if why := too_slow(config):
            yield Finding(Level.STOP, "stabiliser", "rate", f"{config.experiment.rate:g} Hz", why)
        yield from _torque_of_pilot(config)
        yield from _described(config)
        yield _latency_timer(bus)
        yield from _slow_adapter(bus)
        yield from _others(config, bus)
        all_well = True
        for joint_config, joint in zip(config.joints, bus.joints, strict=True):
            for drive, servo in zip(joint.drives, bus.servos(joint), strict=True):
                for finding in check_servo(config, joint_config, drive, servo):
                    all_well &= finding.level is not Level.STOP
                    yield finding
        if not all_well:
            yield Finding(Level.STOP, "bus", "rate", "not measured", "Fix the servo problems above first.")
            return
        yield from _pairs(config, bus)
        goals = list(_goals(bus))
        yield from goals
        if all(finding.level is not Level.STOP for finding in goals):
            yield from _rate(config, bus)
            yield from _still_off(bus)


def _torque_of_pilot(config: Config) -> Iterator[Finding]:
    """Report experiment.peak_torque if a pilot would ignore it, or if it is missing although there is no pilot."""
    if config.experiment.pilot and config.experiment.peak_torque is not None:
        fix = (
            "`hil identify` ignores peak_torque: the pilot finds the torque, up to current_limit or voltage_limit. "
            "Remove peak_torque, or set pilot = false to use it."
        )
        yield Finding(Level.WARNING, "experiment", "torque", "pilot = true takes precedence over peak_torque", fix)
    if not (config.is_chain or config.experiment.pilot) and config.experiment.peak_torque is None:
        fix = f"{how_to_find_torque(config)} Or let hil find it: pilot = true."
        yield Finding(Level.STOP, "experiment", "torque", "experiment.peak_torque is missing", fix)


def _path(config: Config) -> Iterator[Finding]:
    """Report whether a run without a pilot would refuse the path of a spatial arm."""
    if why := missing_path(config):
        yield Finding(Level.STOP, "experiment", "path", "joint_path is missing", why)
        return
    try:
        plan = make_chain_plan(config)
        if not config.is_fake:
            check_clearance(config, plan)
    except (ConfigError, EstimationError) as error:
        yield Finding(Level.STOP, "experiment", "path", "refused", str(error))
    else:
        yield Finding(
            Level.OK, "experiment", "path", "within the torque limits" + ("" if config.is_fake else ", clear")
        )


def _described(config: Config) -> Iterator[Finding]:
    """Report doubts about the description, and whether a spatial arm touches anything in its rest pose."""
    for doubt in doubts(config):
        yield Finding(Level.WARNING, "arm", "description", "doubtful", doubt)
    if not config.is_chain:
        return
    try:
        check_rest_pose(config)
    except ConfigError as error:
        yield Finding(Level.STOP, "arm", "rest pose", "not clear", str(error))
        return
    yield Finding(Level.OK, "arm", "rest pose", "no part touches another part, the floor or a box")
    if not config.experiment.pilot and not too_slow(config):  # which has been reported and would refuse any path
        yield from _path(config)


def _latency_timer(bus: ServoBus) -> Finding:
    url, what = bus.port.url, "latency timer"
    file = latency_timer(url)
    if file is None:
        return Finding(Level.OK, url, what, "none (no FTDI adapter)")
    before_ms = read_latency_ms(file)
    lowered = bus.port.lower_latency()
    found = f"{before_ms} ms" if before_ms <= WANTED_MS else f"was {before_ms} ms, now {read_latency_ms(file)} ms"
    if lowered:
        return Finding(Level.OK, url, what, found)
    level = Level.STOP if before_ms >= FACTORY_MS else Level.WARNING
    return Finding(level, url, what, f"{before_ms} ms; {WANTED_MS} ms is needed", f"Type: {command_to_set(file)}")


def _slow_adapter(bus: ServoBus) -> Iterator[Finding]:
    """Report an adapter that is slower than others of its kind; all later timeouts allow for the delay."""
    what = "adapter"
    try:
        bus.learn_latency()
    except DriverError as error:
        yield Finding(Level.WARNING, bus.port.url, what, "delay not measured", str(error))
        return
    if bus.port.latency_measured:
        found = f"delays replies by {1e3 * bus.port.off_wire:.1f} ms, which limits the rate"
        yield Finding(Level.OK, bus.port.url, what, found)


def _others(config: Config, bus: ServoBus) -> Iterator[Finding]:
    """Report servos that are not part of the arm: nothing is sent to them, but the user should know about them."""
    try:
        check_quiet(bus.port)
    except BusShared as error:
        yield Finding(Level.STOP, config.port.url, "other masters", "another master is active", str(error))
        return
    except DriverError as error:
        yield Finding(Level.WARNING, config.port.url, "other masters", "not checked", str(error))
        return
    try:
        found = others_on_the_bus(bus)
    except WrongSetting as error:
        yield Finding(
            Level.STOP, config.port.url, "other servos on this bus", "one obeys commands meant for this arm", str(error)
        )
        return
    except DriverError as error:
        yield Finding(Level.WARNING, config.port.url, "others", "not searched for", str(error))
        return
    if found:
        fix = "They are left alone: neither their torque nor their settings are changed."
        yield Finding(
            Level.WARNING, config.port.url, "other servos on this bus", "; ".join(each.described for each in found), fix
        )
    for each in found:
        if each.left:
            what = "settings from an earlier run"
            yield Finding(Level.WARNING, config.port.url, what, f"not restored on {each.name}", each.left)


def _pairs(config: Config, bus: ServoBus) -> Iterator[Finding]:
    try:
        for mirrored in mirrored_pairs(config, bus):
            yield Finding(Level.STOP, "arm", "direction", "the two servos of one joint contradict each other", mirrored)
    except DriverError as error:
        yield Finding(Level.STOP, "bus", "direction", "not checked", str(error))


def _still_off(bus: ServoBus) -> Iterator[Finding]:
    """Report servos whose torque was switched on after they were checked. This check itself switches torque neither on
    nor off.
    """
    try:
        on = switched_on(bus.drives)
    except DriverError as error:
        yield Finding(Level.STOP, "bus", "torque", "not read again", str(error))
        return
    if on:
        fix = (
            f"{on}: torque was off when this check began. Another program has switched it on and is driving the arm: "
            "stop that program first, or cut the power."
        )
        yield Finding(Level.STOP, "bus", "torque", "switched on during this check", fix)


def _goals(bus: ServoBus) -> Iterator[Finding]:
    """Check that goals arrive: Sync Write has no reply, so each servo's goal is read back with torque off."""
    try:
        taken = goals_taken(bus)
    except DriverError as error:
        yield Finding(Level.STOP, "bus", "goals", "not tested", str(error))
        return
    for joint, servo in bus.drives.items():
        if joint in taken:
            continue
        tripped = servo.read("Bus Watchdog") == WATCHDOG_TRIPPED
        if tripped:
            yield Finding(
                Level.OK, str(joint), "goals", "refused because its Bus Watchdog has tripped; the next run clears this"
            )
            continue
        fix = (
            "A Sync Write goal did not arrive although the servo answers reads: try port.one_write = false; check "
            "for an adapter or hub that drops bytes, and for a second servo with this ID."
        )
        yield Finding(Level.STOP, str(joint), "goals", "not accepted", fix)


def _rate(config: Config, bus: ServoBus) -> Iterator[Finding]:
    try:
        report = check_rate(bus, config.experiment.rate)
        seldom = "" if report.fix else seldom_as_measured(bus, report.modes)
    except DriverError as error:
        yield Finding(Level.STOP, "bus", "rate", "not measured", str(error))
        return
    for mode in report.modes:
        yield Finding(Level.OK if mode.sound else Level.WARNING, "bus", mode.name, str(mode))
    level = Level.STOP if report.fix else Level.WARNING if report.doubt else Level.OK
    found = f"{config.experiment.rate:g} Hz wanted, {report.found}"
    yield Finding(level, "bus", "rate", found, report.fix or report.doubt)
    if seldom:
        yield Finding(Level.WARNING, "bus", "monitoring", "goals and torque are rarely read back", seldom)
