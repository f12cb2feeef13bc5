"""Possible defects of recordings, described by additional unknowns of a fit.

A defect either scales the measured angles or changes the parameters. The change may vary with time (friction that falls
during warm-up, a load that is picked up), but is constant within a segment.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hil.estimator.arrays import Array, Mask
from hil.estimator.data.recording import Recording
from hil.estimator.data.segments import RecordingSegment
from hil.estimator.models.terms import kind_of, term_of

Kind = Literal["scale", "load", "friction", "torque", "offset", "arm"]
CourseKind = Literal["always", "step", "linear", "decay", "recording"]
Direction = Mapping[str, float]
"""Change in each parameter per unit of an unknown, as a fraction of the parameter; for an offset, in N m."""

MOST_STEPS = 24  # largest number of instants at which a sudden change is tried
EDGE = 2  # minimum number of segments before and after a sudden change
DECAYS = (0.15, 0.4, 1.0)  # time constants to try, relative to the duration of the longest recording
MOST_RECORDINGS = 4  # with at most this many recordings, each is compared with the others
TORQUE_UNITS = ("kg m^2", "N m", "N m s/rad", "N m/rad")


@dataclass(frozen=True)
class Course:
    """How a defect develops over time.

    time: instant of a step, or time constant of a decay [s]. recording: index of the recording that contains the step,
    or that differs from the others.
    """

    kind: CourseKind
    time: float = 0.0
    recording: int = 0


@dataclass(frozen=True)
class Hypothesis:
    """A defect to test. joints: affected joints, counted from 1; empty for the whole arm."""

    kind: Kind
    joints: tuple[int, ...]
    course: Course
    directions: tuple[Direction, ...]
    """One direction per unknown; empty for angle scales, which have one unknown per joint."""
    strength: Array
    """Strength of the defect in each segment (segments,), determined by its course."""
    used: Mask
    """Whether each segment is used (segments,): all but the one in which a sudden change occurs."""

    @property
    def is_absolute(self) -> bool:
        """Whether the parameters change by absolute amounts instead of fractions."""
        return self.kind in {"offset", "scale"}

    @property
    def unknowns(self) -> int:
        return len(self.joints) if self.kind == "scale" else len(self.directions)


def hypotheses(
    recordings: Sequence[Recording], segments: Sequence[RecordingSegment], values: Mapping[str, float], gravity: bool
) -> list[Hypothesis]:
    """Return all defects to test. values: parameters by name [SI]. gravity: whether gravity acts on the arm."""
    joints = recordings[0].joints
    always = np.ones(len(segments))
    # Without gravity, the scale of the first joint's angle cannot be separated from that of its inertia and friction.
    single = [(joint,) for joint in range(1 if gravity else 2, joints + 1)]
    scaled = [*single, *([tuple(range(1, joints + 1))] if len(single) > 1 else [])]
    found = [Hypothesis("scale", which, Course("always"), (), always, always > 0.0) for which in scaled]
    torque = float(np.sqrt(np.mean([np.mean(each.torque**2) for each in recordings])))
    changes = list(_changes(joints, values, torque))
    for course, strength, used in _courses(recordings, segments):
        found += [
            Hypothesis(kind, which, course, directions, strength, used)
            for kind, which, directions in changes
            if _may_develop(kind, course.kind)
        ]
    return found


def _may_develop(kind: Kind, course: CourseKind) -> bool:
    if kind in {"load", "arm"}:
        return course in {"step", "recording"}
    return course != "decay" or kind == "friction"


def _changes(
    joints: int, values: Mapping[str, float], torque: float
) -> Iterator[tuple[Kind, tuple[int, ...], tuple[Direction, ...]]]:
    yield "load", (), _load(joints)
    friction: list[dict[str, float]] = []
    for joint in range(1, joints + 1):
        viscous, dry = {f"viscous_{joint}": 1.0}, {f"coulomb_{joint}": 1.0, f"load_{joint}": 1.0}
        friction.append(viscous | dry)
        yield "friction", (joint,), (viscous, dry)
        yield "torque", (joint,), (_torque_gain(joint, values),)
        yield "offset", (joint,), ({f"offset_{joint}": torque},)
    if joints > 1:
        yield "friction", tuple(range(1, joints + 1)), tuple(friction)
    base = [name for name in values if term_of(name).part == "base" and kind_of(name) != "offset"]
    yield "arm", (), tuple({name: 1.0} for name in base)


def _load(joints: int) -> tuple[Direction, ...]:
    """Return the effects of a mass on the last link; its first moment scales gravity_2 and coupling equally."""
    if joints == 1:
        return ({"inertia_1": 1.0}, {"gravity_1": 1.0})
    return ({"inertia_1": 1.0}, {"gravity_1": 1.0}, {"gravity_2": 1.0, "coupling": 1.0}, {"inertia_2": 1.0})


def _torque_gain(joint: int, values: Mapping[str, float]) -> Direction:
    """Return the effect of a torque that is larger than recorded.

    Joint 1's torque is the reference: if it was larger than recorded, all other values appear smaller.
    """
    if joint > 1:
        return {"torque_scale_2": 1.0}
    less = [name for name in values if term_of(name).unit in TORQUE_UNITS or name == "torque_scale_2"]
    return dict.fromkeys(less, -1.0)


def _courses(
    recordings: Sequence[Recording], segments: Sequence[RecordingSegment]
) -> Iterator[tuple[Course, Array, Mask]]:
    of = np.array([each.recording for each in segments])
    times = [recordings[each.recording].time for each in segments]
    middle = np.array(
        [t[[e.samples.start, e.samples.stop - 1]].mean() - t[0] for t, e in zip(times, segments, strict=True)]
    )
    longest = max(float(each.time[-1] - each.time[0]) for each in recordings)
    everywhere = np.full(len(segments), True)
    yield Course("linear"), middle / longest, everywhere
    for part in DECAYS:
        yield Course("decay", part * longest), np.exp(-middle / (part * longest)), everywhere
    if 1 < len(recordings) <= MOST_RECORDINGS:
        for number in range(1 if len(recordings) == 2 else 0, len(recordings)):
            yield Course("recording", recording=number), np.where(of == number, 1.0, 0.0), everywhere
    places = [k for k in range(len(segments)) if EDGE <= np.sum((of == of[k])[:k]) < np.sum(of == of[k]) - EDGE]
    for k in places[:: max(1, -(-len(places) // MOST_STEPS))]:
        after = (of == of[k]) & (np.arange(len(segments)) > k)
        yield (
            Course("step", float(recordings[of[k]].time[0] + middle[k]), int(of[k])),
            np.where(after, 1.0, 0.0),
            np.arange(len(segments)) != k,
        )
