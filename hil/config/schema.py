"""The TOML file that describes the arm, its limits and its experiment; this module reads and checks it.

`load_config` returns a frozen `Config` or raises ConfigError; its message gives the file, the key, the value and the
allowed values.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from os import PathLike
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    PositiveFloat,
    ValidationError,
    field_validator,
    model_validator,
)

from hil import fakes
from hil.config.bundled import bundled_configs, find_config, meant
from hil.config.chain import MOST_JOINTS, chain_slips, describes_planar
from hil.config.clearance import ClearanceConfig
from hil.config.csv_columns import Columns
from hil.config.experiment import ExperimentConfig, ModelConfig, PathConfig
from hil.config.fake_url import FAKE_URL, url_from
from hil.config.joint import JointConfig
from hil.config.known_quantities import KnownConfig
from hil.config.plausible import implausible
from hil.config.table import Printable, Table, Turned
from hil.drivers.bus import BusConfig
from hil.drivers.servo_model import SERVO_MODELS, WATCHDOG_UNIT, Mode
from hil.errors import ConfigError
from hil.estimator.excitation.harmonics import harmonics_within
from hil.fakes.description import FakeArm, beside, found_beside
from hil.fakes.names import ARMS, arm_names, find_arm
from hil.next_step import command
from hil.toml_errors import describe
from hil.toml_file import TomlFileError, load_toml, parse_toml, read_toml_text, shortened
from hil.unit_hints import in_other_units

__all__ = [
    "ArmConfig",
    "Config",
    "PortConfig",
    "PriorConfig",
    "SafetyConfig",
    "StabiliserConfig",
    "load_config",
    "parse_config",
    "port_url",
]

LYING_RAD = 0.25
"""Largest allowed deviation of a spatial arm from its rest pose at the start [rad], unless arm.rest_tolerance is given.
"""

SLOW_INTERVAL_S = 0.25
"""Interval between slow reads [s], which alternate between the servos' clocks and their voltages and temperatures."""


class PortConfig(Table):
    """`[port]`: the bus to which the servos are connected."""

    url: Printable = Field(
        min_length=1, description='device or pyserial URL; "fake://" opens the [fake] arm of the same file'
    )
    baud: Literal[9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000] = 1_000_000
    one_write: bool = Field(
        True, description="send the goals and the read request in one write; set this as hil check advises"
    )
    fast_sync_read: bool = Field(True, description="use Fast Sync Read if every servo's firmware supports it")


class PriorConfig(Table):
    """`[arm.prior]`: best guesses before any identification, one value per joint.

    Values that are not given are guessed from link lengths and servo models (hil.dry_run.prior); `rough_spread` then
    applies instead of `spread`.
    """

    spread: PositiveFloat = Field(0.3, le=1, description="relative standard deviation of each given value")
    rough_spread: PositiveFloat | None = Field(
        None, le=1, description="relative standard deviation of each guessed value; default depends on the quantity"
    )
    link_mass: list[PositiveFloat] | None = Field(None, description="kg, links without servos")
    link_centre: list[PositiveFloat] | None = Field(None, description="m, from the link's joint to its centre of mass")
    link_inertia: list[PositiveFloat] | None = Field(None, description="kg m^2, about the link's centre of mass")
    servo_mass: list[PositiveFloat] | None = Field(None, description="kg")
    armature: list[PositiveFloat] | None = Field(None, description="kg m^2: rotor inertia times gear ratio squared")
    viscous: list[PositiveFloat] | None = Field(None, description="N m s/rad, including back-EMF in pwm mode")
    coulomb: list[PositiveFloat] | None = Field(None, description="N m")


class ArmConfig(Table):
    """`[arm]`: what is known about the mechanism."""

    gravity: float = Field(9.81, ge=0, le=30, description="m/s^2 in the arm's plane")
    urdf: str | None = Field(
        None, description="URDF or MJCF of a spatial arm: a file next to this one; [[joints]] use its joint names"
    )
    base: Annotated[list[Turned], Field(min_length=3, max_length=3)] = Field(
        [0.0, 0.0, 0.0], description="with urdf: roll, pitch and yaw of the base, rad"
    )
    rest_pose: list[float] = Field(description="rad: where the undriven arm comes to rest")
    rest_tolerance: PositiveFloat = Field(
        0.5,
        description="rad, deviation from the rest pose allowed at the start (friction may hold the arm away from it)",
    )
    link_lengths: list[PositiveFloat] | None = Field(
        None, description="m, from joint to joint and to the tip, for dry runs"
    )
    prior: PriorConfig | None = Field(None, description="prior knowledge of masses and friction, for a dry run")


class SafetyConfig(Table):
    """`[safety]`: conditions other than the joint limits that stop the arm, and how it is stopped."""

    watchdog: float = Field(
        0.08, ge=0.02, le=2.54, description="s, time without packets after which a servo stops by itself"
    )
    allow_no_watchdog: bool = Field(
        False, description="accept firmware without a Bus Watchdog: if packets cease, nothing stops the servo"
    )
    write_current_limit: bool = Field(True, description="lower each servo's Current Limit for the run, then restore it")
    missing_time: PositiveFloat = Field(0.015, le=2, description="s, time for which a servo may fail to reply")
    late_time: PositiveFloat = Field(0.05, le=2, description="s, time for which deadlines may be missed")
    max_missing: int | None = Field(
        None, ge=1, le=1000, description="number of consecutive lost replies allowed, instead of missing_time"
    )
    max_late: int | None = Field(
        None, ge=1, le=1000, description="number of consecutive missed deadlines allowed, instead of late_time"
    )
    rest_time: float = Field(3.0, gt=0, le=60, description="s, time allowed for coming to rest at the end")
    rest_velocity: PositiveFloat = Field(0.1, le=2, description="rad/s, speed below which a joint counts as at rest")
    slew: PositiveFloat = Field(100.0, le=1e4, description="A/s (V/s in PWM mode): maximum rate of change of goals")
    max_temperature: PositiveFloat = Field(70.0, le=100, description="degrees C, highest allowed inside a servo")
    min_voltage: float = Field(
        0.0, ge=0, le=60, description="V, lowest allowed; default: the models' factory shutdown thresholds"
    )
    max_voltage: PositiveFloat = Field(30.0, le=60, description="V")
    follow_time: PositiveFloat = Field(0.05, le=5, description="s, time for which a current may deviate from its goal")
    follow_share: PositiveFloat = Field(
        0.3,
        le=1,
        description="largest current deviation allowed indefinitely, as a fraction of the planned peak",
    )
    take_over: bool = Field(
        False, description="take over an arm whose torque is on, and lower it slowly; by default such an arm is refused"
    )
    stop: Literal["damp", "cut"] = Field("damp", description='"damp" brakes, where possible, before torque is cut')
    damp_time: float = Field(0.06, ge=0, le=2, description="s, maximum braking time")
    lower_speed: PositiveFloat = Field(
        0.6, le=5, description="rad/s, speed at which a stopped spatial arm is lowered to its rest pose"
    )
    lower_time: PositiveFloat = Field(
        10.0, le=60, description="s, time limit for lowering; lower_speed is exceeded if necessary to meet it"
    )
    limit_chance: float = Field(
        0.002, gt=0, le=0.5, description="acceptable probability, in a dry run, of reaching a limit"
    )

    @field_validator("watchdog")
    @classmethod
    def _in_whole_steps(cls, seconds: float) -> float:
        steps = seconds / WATCHDOG_UNIT
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"must be a multiple of {WATCHDOG_UNIT:g} s, the resolution of the servos' Bus Watchdog")
        return seconds


class StabiliserConfig(Table):
    """`[stabiliser]`: a software spring and damper around arm.rest_pose, for arms without a stable rest pose."""

    stiffness: list[float] = Field(description="N m/rad per joint")
    damping: list[float] = Field(description="N m s/rad per joint")

    @model_validator(mode="after")
    def _not_negative(self) -> Self:
        if min(*self.stiffness, *self.damping) < 0:
            raise ValueError(
                "stiffness and damping must be at least 0: negative values would drive the arm away from its pose"
            )
        return self


class Config(Table):
    """The complete configuration. `path` is the file it was read from."""

    path: Path = Field(exclude=True)
    port: PortConfig
    joints: list[JointConfig] = Field(min_length=1, max_length=MOST_JOINTS)
    arm: ArmConfig
    experiment: ExperimentConfig
    joint_path: PathConfig | None = None
    model: ModelConfig = ModelConfig()
    safety: SafetyConfig = SafetyConfig()
    stabiliser: StabiliserConfig | None = None
    clearance: ClearanceConfig = ClearanceConfig()
    known: KnownConfig | None = None
    columns: Columns | None = Field(
        None, description="columns of recordings made with other tools; see hil.config.csv_columns"
    )
    fake: FakeArm | None = None

    @model_validator(mode="before")
    @classmethod
    def _usual_voltage(cls, values: Any) -> Any:
        """Default of safety.min_voltage: the lowest minimum voltage of the servo models."""
        if not isinstance(values, dict) or not isinstance(values.get("safety", {}), dict):
            return values
        joints = values.get("joints")
        names = (
            [str(joint.get("model")) for joint in joints if isinstance(joint, dict)] if isinstance(joints, list) else []
        )
        least = min((SERVO_MODELS[name].min_voltage for name in names if name in SERVO_MODELS), default=0.0)
        return {**values, "safety": {"min_voltage": least, **values.get("safety", {})}}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.joints)
        if self.arm.urdf is None and (slips := [*chain_slips(self)]):  # first: the lists' lengths depend on it
            raise ValueError("; ".join(slips))
        _same_length("arm.rest_pose", self.arm.rest_pose, count)
        for key, values in self._per_joint():
            _same_length(key, values, count)
        slips = [*chain_slips(self), *implausible(self)]
        if slips:
            raise ValueError("; ".join(slips))
        if self.experiment.lines is not None:
            _same_length("experiment.lines", self.experiment.lines, count)
            excited = [line for lines in self.experiment.lines for line in lines]
            if len(set(excited)) != len(excited):
                raise ValueError("experiment.lines: two joints share a harmonic; each joint needs its own harmonics")
        self._check_band()
        _all_different("id", [servo_id for joint in self.joints for servo_id in joint.ids])
        _all_different("name", [joint.name for joint in self.joints])
        for joint, rest in zip(self.joints, self.arm.rest_pose, strict=True):
            _check_rest_pose(joint, rest)
        if self.experiment.peak_torque is not None:
            for joint, peak in zip(self.joints, self.experiment.peak_torque, strict=True):
                _check_peak_torque(joint, peak)
        self._check_pilot()
        if self.model.torque_scale and count != 2 and not self.is_chain:
            raise ValueError("model.torque_scale compares two joints' torque constants: it needs two [[joints]]")
        if self.port.url == FAKE_URL and self.fake is None:
            raise ValueError('port.url = "fake://" needs a [fake] table that describes the fake arm')
        return self

    def _per_joint(self) -> list[tuple[str, list[float]]]:
        lists = {"experiment.peak_torque": self.experiment.peak_torque, "arm.link_lengths": self.arm.link_lengths}
        if self.stabiliser is not None:
            lists |= {"stabiliser.stiffness": self.stabiliser.stiffness, "stabiliser.damping": self.stabiliser.damping}
        if self.joint_path is not None:
            lists |= {f"joint_path.{key}": value for key, value in self.joint_path.model_dump().items()}
        if self.arm.prior is not None:
            guessed = self.arm.prior.model_dump(exclude={"spread", "rough_spread"})
            lists |= {f"arm.prior.{key}": value for key, value in guessed.items()}
        return [(key, value) for key, value in lists.items() if value is not None]

    def _check_band(self) -> None:
        """Check that the band contains a multiple of 1 / period for each joint, unless a path defines the motion."""
        experiment, count = self.experiment, len(self.joints)
        if experiment.band is None or self.is_chain:
            return
        low, high = experiment.band
        lines = len(harmonics_within(experiment.period, low, high))
        if lines < count:
            found = "no multiple" if lines == 0 else "only 1 multiple" if lines == 1 else f"only {lines} multiples"
            raise ValueError(
                f"experiment.band = [{low:g}, {high:g}] Hz contains {found} of 1 / period = {1 / experiment.period:g} "
                f"Hz, but each joint needs its own: lengthen period, or widen band"
            )

    def _check_pilot(self) -> None:
        experiment = self.experiment
        if self.is_chain:
            return
        if experiment.pilot and self.arm.link_lengths is None:
            raise ValueError("experiment.pilot = true needs arm.link_lengths [m], one per joint")
        if experiment.peak_torque is None and self.arm.link_lengths is None:
            raise ValueError(
                "experiment.peak_torque is missing: set it in N m, or set arm.link_lengths and pilot = true"
            )
        if experiment.design == "optimal" and not experiment.pilot:
            raise ValueError('experiment.design = "optimal" needs pilot = true: the design uses the pilot\'s model')

    @property
    def is_chain(self) -> bool:
        """Whether the arm is spatial: its description is not planar, or is used with a [joint_path]."""
        return self.arm.urdf is not None and not (self.joint_path is None and describes_planar(self))

    @property
    def rest_tolerance(self) -> float:
        """Largest allowed deviation from the rest pose at the start [rad]: `arm.rest_tolerance`.

        The default for a spatial arm is LYING_RAD: such an arm lies on a support, and comes to rest closer to
        its rest pose than a hanging arm does.
        """
        is_given = "rest_tolerance" in self.arm.model_fields_set
        return LYING_RAD if self.is_chain and not is_given else self.arm.rest_tolerance

    @property
    def url(self) -> str:
        """The port's URL; for a fake arm, completed with the path of the file that describes it."""
        return url_from(self.port.url, self.path)

    @property
    def bus(self) -> BusConfig:
        return BusConfig(
            self.url,
            self.port.baud,
            tuple(replace(joint.joint, near=rest) for joint, rest in zip(self.joints, self.arm.rest_pose, strict=True)),
            one_write=self.port.one_write,
            fast_sync_read=self.port.fast_sync_read,
            slow_every=max(1, round(SLOW_INTERVAL_S * self.experiment.rate)),
            watchdog_required=not self.safety.allow_no_watchdog,
            take_over=self.safety.take_over,
            interval=1 / self.experiment.rate,
        )

    @property
    def is_fake(self) -> bool:
        return self.port.url.startswith(FAKE_URL)


def load_config(path: str | PathLike[str]) -> Config:
    """Read and check a TOML file, or the bundled one with that name. Raises ConfigError."""
    try:
        path = find_config(Path(path))
        is_folder = path.is_dir()
    except OSError as error:
        raise ConfigError(f"{shortened(str(path))}: {error.strerror}.") from error
    if is_folder:
        if path == Path():
            raise ConfigError(
                ". cannot be read: it is the current folder (an empty name means the same). Name a TOML file."
            )
        within = [*path.glob("*.toml")]
        hint = f"; did you mean {within[0]}?" if len(within) == 1 else ". Name a TOML file."
        raise ConfigError(f"{path} cannot be read: it is a folder{hint}")
    try:
        text = read_toml_text(path)
    except TomlFileError as error:
        raise ConfigError(f"{error}{meant(path)}") from error
    return parse_config(text, path)


def parse_config(text: str, path: Path, *, recorded: bool = False) -> Config:
    """Check the text of a TOML file read from `path`. Raises ConfigError.

    recorded: whether the file is the copy in a run folder. If so, arm.link_lengths of a spatial arm is ignored: older
    versions of hil accepted this key, although it had no effect.
    """
    try:
        values = parse_toml(text, path)
    except TomlFileError as error:
        raise ConfigError(str(error)) from error
    if "path" in values:
        raise ConfigError(f"{path}: path is not a known key.")
    if "joints" not in values and "study" in values:
        raise ConfigError(f"{path}: it describes a study, not an arm. Type: {command('study', path)}")
    if "joints" not in values and "columns" in values:
        raise ConfigError(
            f"{path}: it describes the columns of a recording, not an arm. Type: "
            f"{command('estimate', 'FILE.csv', '--config', path)}"
        )
    if isinstance(values.get("fake"), dict):
        values["fake"] = beside(values["fake"], path.parent)
    arm = values.get("arm")
    if isinstance(arm, dict) and isinstance(arm.get("urdf"), str):
        values["arm"] = {**arm, "urdf": str(found_beside(path.parent, arm["urdf"]))}
    try:
        if recorded and isinstance(arm, dict) and "urdf" in arm and "link_lengths" in arm:
            return _without_lengths(path, values)
        return Config(path=path, **values)
    except ValidationError as error:
        joints = values.get("joints")
        count = len(joints) if isinstance(joints, list) else None
        raise ConfigError(describe(error, path, Config, joints=count)) from error


def _without_lengths(path: Path, values: dict[str, Any]) -> Config:
    """The configuration, without arm.link_lengths if the arm is spatial; only planar arms have this key."""
    lengths = {key: value for key, value in values["arm"].items() if key != "link_lengths"}
    with suppress(ValidationError):
        spatial = Config(path=path, **{**values, "arm": lengths})
        if spatial.is_chain:
            return spatial
    return Config(path=path, **values)


def _same_length(key: str, values: list[float] | list[list[int]], count: int) -> None:
    if len(values) != count:
        entries = "1 entry" if len(values) == 1 else f"{len(values)} entries"
        raise ValueError(f"{key} has {entries}; it needs {count}, one for each [[joints]] table")


def _all_different(key: str, values: Sequence[int | str]) -> None:
    again = [value for place, value in enumerate(values) if value in values[:place]]
    if again:
        raise ValueError(f"joints: two joints have the same {key} {again[0]!r}")


def _check_rest_pose(joint: JointConfig, rest: float) -> None:
    low, high = joint.position_limit
    if not low < rest < high:
        where = "at the end of" if rest in (low, high) else "outside"
        room = "; leave a margin" if rest in (low, high) else ""
        raise ValueError(
            f"arm.rest_pose: {rest:g} rad for joint {joint.name!r} is {where} its position_limit "
            f"[{low:g}, {high:g}]{room}"
        )


def _check_peak_torque(joint: JointConfig, peak: float) -> None:
    most = joint.goal_limit * joint.torque_per_goal
    product = "voltage_limit * torque_per_volt" if joint.drive_mode is Mode.PWM else "current_limit * torque_constant"
    if peak > most * (1 + 1e-9):
        hint = in_other_units(peak, "N m", lambda torque: 0.001 * most < torque <= most)
        raise ValueError(
            f"experiment.peak_torque: {peak:g} N m for joint {joint.name!r} is more than "
            f"{product} = {math.floor(most * 1000) / 1000:g} N m" + (f". {hint}" if hint else "")
        )


def port_url(port: str) -> str:
    """The URL of a port.

    `port` can be a URL or a device, which is returned unchanged; a TOML file; the name of a fake arm that other
    programs use (`koch`); or, if no such arm exists, the name of a bundled configuration. Raises ConfigError.
    """
    url = _url_of(port)
    fakes.register_for(url)
    return url


def _is_only_fake(path: Path) -> bool:
    """Whether a TOML file describes only a fake arm; `hil fake` accepts such a file."""
    try:
        values = load_toml(path)
    except TomlFileError:
        return False
    return "fake" in values and "port" not in values and "joints" not in values


def config_of(port: str) -> Path | None:
    """The configuration that `port` (see `port_url`) refers to; None for a URL, a device or a fake arm."""
    if "://" in port or find_arm(port).parent == ARMS:
        return None
    config = find_config(Path(port))
    return config if (config.suffix == ".toml" or config.is_file()) and not _is_only_fake(config) else None


def _url_of(port: str) -> str:
    if "://" in port:
        return port
    if config := config_of(port):
        return load_config(config).url
    arm = find_arm(port)
    if arm.suffix == ".toml" or arm.is_file():
        return f"{FAKE_URL}{arm}"
    close = get_close_matches(port, [*arm_names(), *bundled_configs()], 1, 0.8)
    if close and not Path(port).exists():
        raise ConfigError(f"{port}: there is no such port, file or arm; did you mean {close[0]}?")
    return port
