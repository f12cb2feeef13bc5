"""Compare the arm with its description: each joint in turn is moved by hand, with torque off, and its angle is read.

An identification of a spatial arm cannot detect wrong IDs, directions, zeros or axes.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hil.config.chain import base_up, described_arm
from hil.config.joint import JointConfig
from hil.config.schema import Config
from hil.description.motion import end_point, moves
from hil.drivers.clock import Clock
from hil.estimator.arrays import Array
from hil.rest_pose_hint import within_limits

MOVED = 0.15  # rad: a joint that has moved farther counts as moved by hand
STILL = 0.02  # rad: a joint that moves less than this in STILL_S is held still
STILL_S = 0.6
POLL_S = 0.05
PATIENCE_S = 60.0
SEVERAL = 0.4  # largest motion of another joint that is not reported, relative to that of the moved joint
Read = Callable[[], tuple[float, ...]]
ReadDrives = Callable[[int], tuple[float, ...]]


@dataclass(frozen=True)
class Pose:
    """A pose of the arm."""

    angles: tuple[float, ...]
    """Joint angles in the description's convention [rad]."""
    end: tuple[float, float, float]
    """Centre of mass of the end link in the base frame [m]."""


@dataclass(frozen=True)
class Moved:
    """What happened when one joint was moved by hand."""

    joint: str
    asked: str
    """Request that was shown to the user."""
    angles: tuple[float, ...]
    """Angle by which each joint moved [rad]."""
    well: bool
    found: str
    """The finding as text. If the motion differs from the description, the text also says what to change."""


def pose_of(config: Config, angles: tuple[float, ...]) -> Pose:
    """Return the pose of the arm at these joint angles [rad].

    A servo does not count whole turns while it is off. An angle outside the position limits is shifted by whole turns
    to lie within them.
    """
    limits = [joint.position_limit for joint in config.joints]
    angles = tuple(within_limits(*each) for each in zip(angles, limits, strict=True))
    x, y, z = end_point(described_arm(config), np.array(angles)).tolist()
    return Pose(angles, (x, y, z))


def guided(
    config: Config, read: Read, clock: Clock, ask: Callable[[str], None], read_drives: ReadDrives
) -> Iterator[Moved]:
    """Ask for each joint in turn to be moved in its positive direction, and compare the motion with the description.

    read: returns the angles of all joints [rad]. read_drives: returns a joint's angle according to each of its servos
    [rad].
    """
    arm, up = described_arm(config), base_up(config)
    for index, joint in enumerate(config.joints):
        before, drives = np.array(read()), np.array(read_drives(index))
        asked = f"Move {joint.name!r} by hand by about 0.3 rad in the direction that {moves(arm, before, index, up)}."
        ask(asked)
        change = _awaited(read, clock, before)
        yield judge(config, index, asked, change, np.array(read_drives(index)) - drives)


def judge(config: Config, asked_for: int, asked: str, change: Array, drives: Array) -> Moved:
    """Compare a motion `change` (joints,) [rad] with the requested one.

    drives: motion of the requested joint according to each of its servos, in their order [rad].
    """
    joint = config.joints[asked_for]
    most = int(np.argmax(np.abs(change)))
    angles = tuple(change.tolist())
    if abs(change[most]) < MOVED:
        found = (
            f"{joint.name!r} did not move: is {joint.id} the ID of its servo? If a joint that is not in "
            "[[joints]] moved instead, the IDs are wrong"
        )
        return Moved(joint.name, asked, angles, False, found)
    if most != asked_for:
        other = config.joints[most]
        found = (
            f"{other.name!r} (ID {other.id}) moved by {change[most]:+.2f} rad instead: swap the ids of the two, or "
            "their names, in [[joints]]"
        )
        return Moved(joint.name, asked, angles, False, found)
    if unlike := _unlike(joint, drives):
        return Moved(joint.name, asked, angles, False, unlike)
    if change[most] < 0.0:
        found = (
            f"{joint.name!r} moved by {change[most]:+.2f} rad, so its angle increases in the direction opposite to the "
            f"description's: set direction = {_reversed(joint)} and determine zero_ticks again, or correct the axis"
        )
        return Moved(joint.name, asked, angles, False, found)
    along = [
        other.name
        for number, other in enumerate(config.joints)
        if number != most and abs(change[number]) > SEVERAL * abs(change[most])
    ]
    found = f"{joint.name!r} moved by {change[most]:+.2f} rad, as described"
    found += ", and so did its second servo" if len(joint.ids) > 1 else ""
    return Moved(joint.name, asked, angles, True, found + (f"; {', '.join(along)} moved with it" if along else ""))


def _reversed(joint: JointConfig) -> list[int] | int:
    reverse = [-sign for sign in joint.directions]
    return reverse if len(reverse) > 1 else reverse[0]


def _unlike(joint: JointConfig, drives: Array) -> str:
    """Return a message if the motion of a joint's two servos contradicts their configured directions, otherwise ""."""
    if len(joint.ids) == 1 or abs(drives[1] - drives[0]) <= SEVERAL * abs(drives[0]):
        return ""
    first, second = joint.ids
    measured = f"its servos disagree: ID {first} turned by {drives[0]:+.2f} rad, ID {second} by {drives[1]:+.2f} rad"
    if abs(drives[1] + drives[0]) > SEVERAL * abs(drives[0]):
        return f"{joint.name!r}: {measured}. Is ID {second} on this joint, and is its horn tight?"
    right = [int(np.sign(turned)) * sign for turned, sign in zip(drives, joint.directions, strict=True)]
    return (
        f"{joint.name!r}: {measured}, so under torque they work against each other: set direction = {right}"
        f"{' and determine zero_ticks again' if right[0] != joint.direction else ''}"
    )


def _awaited(read: Read, clock: Clock, before: Array) -> Array:
    """Return all joints' displacements once a joint has been moved by hand and held still, or after a timeout."""
    end = clock.now() + PATIENCE_S
    held_since, last = clock.now(), before
    while clock.now() < end:
        clock.wait_until(clock.now() + POLL_S)
        here = np.array(read())
        if np.abs(here - last).max() > STILL:
            held_since, last = clock.now(), here
        elif np.abs(here - before).max() > MOVED and clock.now() - held_since > STILL_S:
            break
    change: Array = np.array(read()) - before
    return change
