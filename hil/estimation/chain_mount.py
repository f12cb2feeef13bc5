"""What the verdict says about a spatial arm whose centres of mass contradict its description: how its base is mounted,
or a joint's direction, axis or encoder zero.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hil.config.chain import mount_angles
from hil.description.arm import ArmDescription
from hil.estimator.arrays import Array
from hil.estimator.chain.mount import Opposed
from hil.estimator.models.conflicts import Trust

_ACROSS = 0.1  # sine of the angle by which an axis may differ from being perpendicular to gravity


@dataclass(frozen=True)
class MountDoubt:
    """A contradiction between the centres of mass and the description.

    at_most: the most favourable verdict that it allows. said: sentences for the verdict. first: what to do before the
    next command.
    """

    at_most: Trust
    said: tuple[str, ...]
    first: str


def mounted_otherwise(
    arm: ArmDescription,
    opposed: Sequence[Opposed],
    assumed: Array,
    gravity: Array,
    explained: bool,
    is_run: bool = True,
) -> MountDoubt:
    """State that estimate and description agree if the base is mounted differently.

    Args:
        arm: the description.
        opposed: moments whose signs contradict the description; may be empty.
        assumed: configured gravity in the base's frame (3,) [m/s^2].
        gravity: gravity for which estimate and description agree, in the same form; see `better_gravity`.
        explained: whether the model explains the motion.
        is_run: whether the recording is a run, and not one made by another program.
    """
    base, before = mount_angles(gravity), mount_angles(assumed)
    where = "run's config.toml" if is_run else "configuration"
    contradiction = _on_the_other_side(arm, opposed) if opposed else f"The recording contradicts {arm.path.name}."
    return MountDoubt(
        "with care" if explained else "no",
        (
            contradiction,
            f"The two agree if the base is mounted differently: {_mount_said(gravity)}, base = {base} under [arm]; the "
            f"configuration implies {before}, apart from a rotation about the vertical. Check how the arm is mounted, "
            f"and correct base.{_same_as(arm, assumed, gravity, is_run)} The recording remains usable: after base has "
            f"been corrected in the {where}, `hil estimate` suffices.",
            _still_right(explained),
        ),
        f"set base = {base} under [arm], or correct what else is wrong (see the verdict)",
    )


def mass_on_the_other_side(
    arm: ArmDescription, opposed: Sequence[Opposed], explained: bool, is_run: bool = True
) -> MountDoubt | None:
    """State which moments contradict the description in sign, and what may be wrong; None if there are none.

    is_run: whether the recording is a run, and not one made by another program.
    """
    if not opposed:
        return None
    joints = ", ".join(arm.joints[link - 1].name for link in sorted({each.link for each in opposed}))
    zero, signs = _zero_key(is_run), "`direction`" if is_run else "the signs"
    shown = " (`hil pose` shows the angles)" if is_run else ""
    return MountDoubt(
        "with care",
        (
            _on_the_other_side(arm, opposed),
            "Standing, hanging and wall mounts were tried in place of `base`, but none of them agrees better. Check, "
            f"in this order: `base`, the orientation of the mount; {signs} and the axis of these joints and of those "
            f"before them; {zero}, which may be off by 90 or 180 degrees{shown}; the centres of mass in the "
            "description.",
            _still_right(explained),
        ),
        f"check base, and {signs.strip('`')} and {zero} of {joints} (see the verdict); if all are right, the result "
        "can be exported",
    )


def _zero_key(is_run: bool) -> str:
    return "zero_ticks" if is_run else "columns.zero"


def _on_the_other_side(arm: ArmDescription, opposed: Sequence[Opposed]) -> str:
    parts = [
        f"{each.name} is {each.value:.3g} +- {each.std:.1g} kg m instead of {each.expected:.3g} kg m (link "
        f"{arm.joints[each.link - 1].link} of joint {arm.joints[each.link - 1].name})"
        for each in opposed
    ]
    return (
        f"The recording contradicts {arm.path.name}: gravity acts as if centres of mass were on the opposite side, "
        f"{'; '.join(parts)}."
    )


def _mount_said(gravity: Array) -> str:
    """Describe in words how the base is mounted, given gravity in its frame (3,)."""
    down = gravity / np.linalg.norm(gravity)
    axis = int(np.argmax(np.abs(down)))
    if abs(down[axis]) < 1.0 - 1e-6:
        return "turned upside down"
    if axis == 2:
        return "hanging upside down" if down[2] > 0.0 else "standing upright"
    return f"on a wall with its {'xy'[axis]} axis pointing {'down' if down[axis] > 0.0 else 'up'}"


def _same_as(arm: ArmDescription, assumed: Array, gravity: Array, is_run: bool) -> str:
    """State that an encoder zero of the first joint would have the same effect, if it would."""
    first = arm.joints[0]
    axis = first.rotation @ first.axis
    before, after = (each / np.linalg.norm(each) for each in (assumed, gravity))
    if max(abs(float(axis @ before)), abs(float(axis @ after))) > _ACROSS:
        return ""
    turned = math.degrees(math.acos(max(-1.0, min(1.0, float(before @ after)))))
    return (
        f" A zero of {first.name} that is off by {turned:.0f} degrees has the same effect: if base is right, correct "
        f"{_zero_key(is_run)} of {first.name}."
    )


def _still_right(explained: bool) -> str:
    if explained:
        return (
            "Friction and the torques at the measured angles are right for the arm as it is mounted now; the centres "
            "of mass and the exported links are not those of the described arm."
        )
    return "The other values are distorted as well, since the model does not explain the motion."
