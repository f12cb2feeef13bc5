"""Requirements on the configuration of a spatial arm, and the arm's description read from a URDF."""

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hil.description.arm import ArmDescription, ArmFileError
from hil.description.files import read_arm
from hil.description.planar import is_planar
from hil.description.urdf import rotation_of
from hil.errors import ConfigError
from hil.estimator.arrays import Array
from hil.unit_hints import in_other_units

if TYPE_CHECKING:
    from hil.config.schema import Config

MOST_JOINTS = 7
POSITION_RESERVE = 0.08
"""Fraction of a joint's position range that a designed path leaves free at each end."""

DEFAULT_BAND = (0.1, 1.5)
"""Default frequency band of the excitation in a spatial arm's pilot [Hz]."""

_MOST_TURNED_RAD = 4.5 * math.pi
_SAME_GRAVITY = 0.1  # m/s^2
_HARMONICS = 2  # minimum number of harmonics for a path
_PLANAR = 2
_WIDER_RAD = 1e-3
_OPTIONS = ("presliding", "asymmetry", "ripple", "cogging", "saturation", "cable", "encoder")


def described_arm(config: "Config") -> ArmDescription:
    """Read the arm that the configured joints form from the file in `[arm] urdf`. Raises ArmFileError."""
    assert config.arm.urdf is not None
    return _read(config.arm.urdf, tuple(joint.name for joint in config.joints), _changed(config.arm.urdf))


def doubted_inertias(arm: ArmDescription) -> tuple[str, ...]:
    """Return one sentence for each inertia in the description that no real body can have."""
    return tuple(f"{arm.path.name}: {doubt}." for doubt in arm.doubts)


def doubted_limits(config: "Config") -> Iterator[str]:
    """Yield one sentence for each joint whose limits in the description are invalid or do not contain the joint's path.

    position_limit is allowed to exceed the described limits at either end by the margin that a path leaves free.
    """
    arm = described_arm(config)
    wanted = config.joint_path
    for index, (joint, described) in enumerate(zip(config.joints, arm.joints, strict=True)):
        if described.limits is None or described.limits == (0.0, 0.0):  # (0, 0) means that limits are missing
            continue
        lower, upper = described.limits
        where = f'{arm.path.name}: the limits of joint "{joint.name}" are [{lower:g}, {upper:g}] rad'
        if lower >= upper:
            wrong = ", but they are equal" if lower == upper else ", but the lower limit must come first"
            yield f"{where}{wrong}. These limits are ignored; correct them."
            continue
        if max(-lower, upper) > _MOST_TURNED_RAD:
            in_rad = f"[{math.radians(lower):.3g}, {math.radians(upper):.3g}]"
            yield f"{where}: are these degrees? Limits must be in radians: {in_rad}."
            continue
        low, high = joint.position_limit
        free = POSITION_RESERVE * (high - low)
        low, high = low + free, high - free
        if wanted is not None:
            centre, swing = wanted.centre[index], wanted.swing[index]
            low, high = centre - swing, centre + swing
        if low < lower - _WIDER_RAD or high > upper + _WIDER_RAD:
            key = "position_limit" if wanted is None else "joint_path"
            shown = f"position_limit = [{joint.position_limit[0]:g}, {joint.position_limit[1]:g}]"
            yield (
                f"{where}, but {key} lets it move from {low:.3g} to {high:.3g} rad ({shown}): it may run into its "
                f"end stops. Narrow {key}, or correct the limits."
            )


def doubted_gravity(config: "Config") -> Iterator[str]:
    """Yield a sentence if the gravity in the file differs from the configured gravity, which is the one used."""
    arm = described_arm(config)
    if arm.gravity is None or np.abs(np.subtract(arm.gravity, base_gravity(config))).max() <= _SAME_GRAVITY:
        return
    used = [round(each, 4) + 0.0 for each in base_gravity(config).tolist()]
    yield (
        f"{arm.path.name}: its gravity, {list(arm.gravity)} m/s^2, is not used. [arm] base and gravity give {used} "
        f"in the frame of the base. {_mounted(np.array(arm.gravity))}"
    )


def _mounted(gravity: Array) -> str:
    """Explain which settings produce this gravity in the frame of the base (3,) [m/s^2]."""
    strength = float(np.linalg.norm(gravity))
    if strength <= _SAME_GRAVITY:
        return "The file sets gravity to zero: correct it."
    base = mount_angles(gravity)
    return f"If the arm is mounted as the file says, set base = {base} and gravity = {strength:.4g} under [arm]."


def mount_angles(gravity: Array) -> list[float]:
    """Roll, pitch and yaw for `base` [rad] that produce this direction of gravity in the frame of the base (3,)."""
    x, y, z = (-gravity / float(np.linalg.norm(gravity)) + 0.0).tolist()
    return [round(angle, 4) + 0.0 for angle in (math.atan2(y, z), -math.asin(max(-1.0, min(1.0, x))), 0.0)]


def base_gravity(config: "Config") -> Array:
    """Gravity in the base frame (3,) [m/s^2]."""
    down = np.array([0.0, 0.0, -config.arm.gravity])
    turned: Array = rotation_of(*config.arm.base).T @ down
    return turned


def base_up(config: "Config") -> Array:
    """The direction opposite to gravity in the base frame (3,)."""
    turned: Array = rotation_of(*config.arm.base).T @ np.array([0.0, 0.0, 1.0])
    return turned


def describes_planar(config: "Config") -> bool:
    """Whether the arm of `[arm] urdf` is planar; False if the file cannot be read."""
    try:
        return is_planar(described_arm(config), base_gravity(config))
    except ArmFileError:
        return False


def only_planar(config: "Config", what: str) -> None:
    """Raise ConfigError if the arm is spatial. The message says that `what` supports only planar arms."""
    if config.is_chain:
        raise ConfigError(
            f"{config.path}: {what} supports only planar arms so far; this one has arm.urdf. For spatial arms, use "
            "`hil identify`, `hil dry-run`, `hil estimate`, `hil report` and `hil export`."
        )


def chain_slips(config: "Config") -> Iterator[str]:
    """Yield one sentence per mistake in the configuration of a spatial arm; nothing for a valid planar arm."""
    if config.arm.urdf is None:
        yield from _planar_slips(config)
        return
    try:
        described_arm(config)
    except ArmFileError as error:
        yield f"arm.urdf: {error}"
        return
    if not config.is_chain:
        yield from _planar_slips(config)
        return
    if config.arm.link_lengths is not None:
        yield "arm.link_lengths: a spatial arm takes its lengths from arm.urdf; remove one of the two"
    fake = None if config.fake is None or config.fake.chain is None else Path(config.fake.chain.urdf)
    if fake is not None and fake.name == Path(config.arm.urdf).name and fake != Path(config.arm.urdf):
        yield (
            f"arm.urdf and fake.chain.urdf are different files, but both are named {fake.name}; a run folder must hold "
            "both: rename one"
        )
    if config.experiment.pilot:
        if config.joint_path is not None:
            yield "joint_path: with experiment.pilot = true the path is designed automatically; remove one of the two"
    elif config.stabiliser is None:
        yield (
            "stabiliser is missing: a spatial arm does not hang at rest, so a spring and a damper must hold it "
            "on its path. Give both, or set experiment.pilot = true, which finds them"
        )
    if config.known is not None:
        yield "known: only for planar arms; a URDF already gives the masses"
    told = [option for option in _OPTIONS if getattr(config.model, option)]
    if told:
        yield f"model.{told[0]} = true: only planar arms support this term so far; remove it"
    yield from _ignored_slips(config)
    yield from _path_slips(config)


def _ignored_slips(config: "Config") -> Iterator[str]:
    arm = described_arm(config)
    holders = {part: joint.link for joint in arm.joints for part in joint.fixed}
    names = (arm.base, *(joint.link for joint in arm.joints), "floor", *(box.name for box in config.clearance.boxes))
    for name in dict.fromkeys(name for pair in config.clearance.ignore for name in pair if name not in names):
        part = f": it is part of {holders[name]!r}" if name in holders else ""
        yield f"clearance.ignore: {name!r} is not a known name{part}; allowed names are {', '.join(names)}"


def _planar_slips(config: "Config") -> Iterator[str]:
    if config.arm.urdf is None and len(config.joints) > _PLANAR:
        yield (
            f"joints: {len(config.joints)} joints need arm.urdf, which gives the geometry; without it, an "
            "arm has one or two joints"
        )
    if config.arm.urdf is None and config.joint_path is not None:
        yield "joint_path: only an arm with arm.urdf follows a path; a planar arm uses experiment.peak_torque"
    if config.model.base_tilt:
        yield "model.base_tilt: the tilt of a planar arm has the effect of a wrong zero of joint 1: use model.zeros"


def _path_slips(config: "Config") -> Iterator[str]:
    if config.experiment.band is None:
        yield (
            "experiment.lines: only for planar arms; a spatial arm follows a path, and the upper end of "
            "experiment.band is its highest frequency"
        )
    high = (config.experiment.band or DEFAULT_BAND)[1]
    if config.experiment.period * high < _HARMONICS - 1e-9:
        yield (
            f"experiment.period = {config.experiment.period:g} s: a path needs at least {_HARMONICS} harmonics below "
            f"the upper end of its band, {high:g} Hz. Set period to at least {_HARMONICS / high:.3g} s; 8 to 10 s is "
            "usual"
        )
    if config.joint_path is None:
        return
    least = min(joint.velocity_limit for joint in config.joints)
    parts = zip(config.joints, *config.joint_path.model_dump().values(), strict=False)
    for joint, centre, swing, speed in parts:
        low, high = joint.position_limit
        if centre - swing < low or centre + swing > high:
            yield (
                f"joint_path: {joint.name!r} goes from {centre - swing:g} to {centre + swing:g} rad, outside its "
                f"position_limit [{low:g}, {high:g}]"
            )
        if speed > joint.velocity_limit:
            hint = in_other_units(speed, "rad/s", lambda limited: limited <= least)
            yield (
                f"joint_path.speed: {speed:g} rad/s for {joint.name!r} is above its velocity_limit of "
                f"{joint.velocity_limit:g} rad/s" + (f". {hint}" if hint else "")
            )


def _changed(path: str) -> float:
    """The file's modification time [s]; the file is read again when this changes."""
    try:
        return Path(path).stat().st_mtime
    except OSError:
        return 0.0


@lru_cache(maxsize=8)
def _read(path: str, joints: tuple[str, ...], _changed_at: float) -> ArmDescription:
    return read_arm(Path(path), joints)
