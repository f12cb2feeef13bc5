"""Detection of torque or position columns with the wrong sign, by inverse dynamics for each combination of signs.

Angles that are measured from a fixed direction instead of from the previous link are detected in the same way.

If the torque of the only joint, or of all joints, is reversed, the residual stays the same but inertias and friction
become negative. If only one of two torques is reversed, it contradicts the other joint's equations, and the residual
increases.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from hil.estimator.arrays import Array
from hil.estimator.baselines.idim import InverseDynamics, fit_inverse_dynamics
from hil.estimator.baselines.zero import turned_zeros
from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError, RecordingError

CUTOFF = 8.0  # Hz
COULOMB_WIDTH = 0.05  # rad/s
LESS_RESIDUAL = 0.6
"""A combination is credible if its residual is below this fraction of the residual with the signs as given."""

SAME_RESIDUAL = 1.05
"""A combination that makes a negative inertia or friction positive is credible even if its residual is up to this
multiple of the residual with the signs as given, provided that it explains most of the torque (MOST_LEFT).
"""

MOST_LEFT = 0.5
QUARTERS = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)  # rad; angles to try between the zero directions of two joints

ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0, "turns": 2.0 * np.pi}
"""Units that may be mistaken for each other [rad]."""

_POSITIVE = ("inertia", "viscous", "coulomb")
_STANDARD_ERRORS = 3.0


@dataclass(frozen=True)
class Signs:
    """A combination of signs of each joint's torque and position (joints,): +1 unchanged, -1 reversed."""

    torque: tuple[int, ...]
    position: tuple[int, ...]

    @property
    def reversed_columns(self) -> tuple[str, ...]:
        """Descriptions of the reversed columns, such as "the torque of joint 1"."""
        named = [f"the torque of joint {joint}" for joint, sign in enumerate(self.torque, start=1) if sign < 0]
        return (*named, *(f"the position of joint {joint}" for joint, sign in enumerate(self.position, 1) if sign < 0))

    def said(self, joints: Sequence[str] = ()) -> str:
        """The subject of a sentence about the reversed signs, such as "the signs of both torques".

        joints: names of the joints, by default their numbers.
        """
        names = joints or [f"joint {number}" for number in range(1, len(self.torque) + 1)]
        listed = [
            _columns(kind, signs, names) for kind, signs in (("torque", self.torque), ("position", self.position))
        ]
        plural = "s" if self.are_several else ""
        return f"the sign{plural} of {' and '.join(each for each in listed if each)}"

    def fewest(self) -> "Signs":
        """These signs or the opposite ones, whichever reverse fewer columns. Both describe the same motion, because
        reversing all signs mirrors the arm.
        """
        mirrored = Signs(*(tuple(-sign for sign in signs) for signs in (self.torque, self.position)))
        return min(self, mirrored, key=lambda each: len(each.reversed_columns))

    @property
    def are_several(self) -> bool:
        """Whether more than one column is reversed."""
        return len(self.reversed_columns) > 1


def _columns(kind: str, signs: Sequence[int], names: Sequence[str]) -> str:
    found = [name for name, sign in zip(names, signs, strict=True) if sign < 0]
    if len(found) < 2:
        return f"the {kind} of {found[0]}" if found else ""
    if len(found) == len(names):
        return f"both {kind}s" if len(names) == 2 else f"all {kind}s"
    common = "joints " if all(name.startswith("joint ") for name in found) else ""
    short = [name.removeprefix("joint ") if common else name for name in found]
    return f"the {kind}s of {common}{', '.join(short[:-1])} and {short[-1]}"


@dataclass(frozen=True)
class Suspicion:
    """Columns that appear to be reversed.

    signs: the combination that explains the recordings.
    residual, residual_given: relative RMS of the torque residual of the worst joint, with these signs and with the
    signs as given.
    """

    signs: Signs
    residual: float
    residual_given: float
    impossible: tuple[str, ...]
    """Parameters that are significantly negative with the signs as given."""


def suspect_signs(recordings: Sequence[Recording], unknown_zeros: bool = False) -> Suspicion | None:
    """Return the reversal that explains the recordings much better than the given signs.

    unknown_zeros: whether the zeros are not known, so that they are estimated anew for each combination of signs.

    Returns None if there is no such reversal or if filtered inverse dynamics cannot be solved.
    """
    joints = recordings[0].joints
    fit = _fit_unzeroed if unknown_zeros else _fit
    given = fit(recordings, Signs((1,) * joints, (1,) * joints))
    if given is None:
        return None
    impossible, left = _impossible(given), float(given.relative_residual.max())
    best: tuple[float, Signs] | None = None
    for signs in _combinations(joints):
        fitted = fit(recordings, signs)
        if fitted is None or _impossible(fitted):
            continue
        residual = float(fitted.relative_residual.max())
        credible = residual < LESS_RESIDUAL * left or (
            bool(impossible) and residual < min(SAME_RESIDUAL * left, MOST_LEFT)
        )
        if credible and (best is None or residual < best[0]):
            best = residual, signs
    return None if best is None else Suspicion(best[1].fewest(), best[0], left, impossible)


@dataclass(frozen=True)
class Absolute:
    """An angle of joint 2 that seems to be measured from a fixed direction instead of from link 1.

    residual, residual_given: relative RMS of the worst joint's torque residual, using the difference between the angles
    and using the angle as given. turned: angle [rad] that must be added to this difference.
    """

    residual: float
    residual_given: float
    turned: float


def suspect_absolute(recordings: Sequence[Recording], turned: Sequence[float] = ()) -> Absolute | None:
    """Return evidence that joint 2's angle is absolute; None if an absolute angle does not explain the recordings much
    better.

    turned: angles [rad] to try adding to the difference, in case the two angles were measured from different
    directions; quarter turns are always tried. If several fit equally well, the first is chosen.
    """
    if recordings[0].joints != 2:
        return None
    found = []
    for angle in (*turned, *QUARTERS):
        evidence = _better_explained(recordings, [_difference(each, angle) for each in recordings])
        if evidence is not None:
            found.append(Absolute(*evidence, angle))
    least = min((each.residual for each in found), default=np.inf)
    return next((each for each in found if each.residual <= SAME_RESIDUAL * least), None)


def suspect_absolute_unzeroed(recordings: Sequence[Recording]) -> Absolute | None:
    """Like `suspect_absolute`, but for recordings with unknown zeros.

    The zeros are estimated from gravity after the difference between the angles has been taken.
    """
    if recordings[0].joints != 2:
        return None
    apart = [_difference(each, 0.0) for each in recordings]
    if turned_zeros(apart) is None:
        return None
    evidence = _better_explained(recordings, _zeroed(apart))
    return None if evidence is None else Absolute(*evidence, 0.0)


def _difference(recording: Recording, turned: float) -> Recording:
    """Return the recording with the angle of joint 2 relative to that of joint 1, plus `turned` [rad]."""
    first, second = recording.position
    return replace(recording, position=np.stack([first, second - first + turned]))


def suspect_swapped(recordings: Sequence[Recording]) -> tuple[float, float] | None:
    """Return evidence that the torques of two joints are swapped.

    The result is the relative RMS of the worst joint's torque residual, first with the torques swapped, then with the
    torques as given; None if swapping them does not explain the recordings much better.
    """
    if recordings[0].joints != 2:
        return None
    return _better_explained(recordings, [replace(each, torque=each.torque[::-1].copy()) for each in recordings])


def suspect_order(recordings: Sequence[Recording], torques: bool = True) -> tuple[float, float] | None:
    """Return evidence that the angles of two joints, and by default also their torques, are swapped.

    See `suspect_swapped` for the result.
    """
    if recordings[0].joints != 2:
        return None
    order = slice(None, None, -1 if torques else 1)
    other = [
        replace(
            each,
            torque=each.torque[order].copy(),
            position=each.position[::-1].copy(),
            position_step=each.position_step[::-1].copy(),
        )
        for each in recordings
    ]
    return _better_explained(recordings, _zeroed(other))


@dataclass(frozen=True)
class OtherUnit:
    """A unit of the angles that explains the recordings much better than the stated one.

    residual, residual_given: relative RMS of the worst joint's torque residual, with this unit and with the stated one.
    """

    stated: str
    true: str
    residual: float
    residual_given: float


def suspect_unit(recordings: Sequence[Recording], zero: Sequence[float] = ()) -> OtherUnit | None:
    """Return evidence that all angles are in another unit than stated; None if that would not explain the recordings
    much better.

    zero: zeros [rad] that the angles include, by default 0.
    """
    zeros = np.zeros(recordings[0].joints) if not len(zero) else np.array(zero)
    given, found = _fit_as_given(recordings), []
    for (stated, unit), (true, other) in permutations(ANGLE_UNITS.items(), 2):
        try:
            scaled = [_in_unit(each, zeros, other / unit) for each in recordings]
        except RecordingError:  # angles that no joint has
            continue
        # The filter biases friction if the motion is fast.
        evidence = _better_than(given, _zeroed(scaled), ("inertia",))
        if evidence is not None:
            found.append(OtherUnit(stated, true, *evidence))
    return min(found, key=lambda each: each.residual, default=None)


def _in_unit(recording: Recording, zeros: Array, factor: float) -> Recording:
    position = factor * (recording.position - zeros[:, None]) + zeros[:, None]
    return replace(recording, position=position, position_step=factor * recording.position_step)


def _zeroed(recordings: Sequence[Recording]) -> Sequence[Recording]:
    """Return the recordings with the zeros that gravity shows."""
    zeros = turned_zeros(recordings)
    if zeros is None:
        return recordings
    return [replace(each, position=each.position + zeros[:, None]) for each in recordings]


def _better_explained(recordings: Sequence[Recording], changed: Sequence[Recording]) -> tuple[float, float] | None:
    """Return the worst joint's relative RMS torque residual, first with the changed recordings, then with the given
    ones; None if the change does not explain them much better.
    """
    return _better_than(_fit_as_given(recordings), changed)


def _better_than(
    given: InverseDynamics | None, changed: Sequence[Recording], positive: tuple[str, ...] = _POSITIVE
) -> tuple[float, float] | None:
    """The same for a fit to the recordings as given. positive: kinds of parameters that must not be negative."""
    fitted = _fit_as_given(changed)
    if given is None or fitted is None or any(name.startswith(positive) for name in _impossible(fitted)):
        return None
    residual, left = float(fitted.relative_residual.max()), float(given.relative_residual.max())
    return (residual, left) if residual < LESS_RESIDUAL * left else None


def _combinations(joints: int) -> Iterator[Signs]:
    """Yield all combinations of signs, those with the fewest reversals first.

    The sign of joint 1's position is never reversed, which excludes mirror images of the arm.
    """
    every = (
        Signs(torque, (1, *position))
        for torque in product((1, -1), repeat=joints)
        for position in product((1, -1), repeat=joints - 1)
    )
    yield from sorted((signs for signs in every if signs.reversed_columns), key=lambda each: len(each.reversed_columns))


def with_signs(recordings: Sequence[Recording], signs: Signs) -> list[Recording]:
    """Return the recordings with the columns of `signs` reversed."""
    torque, position = (np.array(each, dtype=float)[:, None] for each in (signs.torque, signs.position))
    return [replace(each, torque=each.torque * torque, position=each.position * position) for each in recordings]


def _fit(recordings: Sequence[Recording], signs: Signs) -> InverseDynamics | None:
    try:
        return fit_inverse_dynamics(with_signs(recordings, signs), CUTOFF, COULOMB_WIDTH)
    except EstimationError:
        return None


def _fit_as_given(recordings: Sequence[Recording]) -> InverseDynamics | None:
    as_given = (1,) * recordings[0].joints
    return _fit(recordings, Signs(as_given, as_given))


def _fit_unzeroed(recordings: Sequence[Recording], signs: Signs) -> InverseDynamics | None:
    return _fit_as_given(_zeroed(with_signs(recordings, signs)))


def _impossible(fitted: InverseDynamics) -> tuple[str, ...]:
    """Return the names of inertias and friction parameters that are significantly negative."""
    bad = fitted.value < -_STANDARD_ERRORS * fitted.std
    return tuple(
        name for name, negative in zip(fitted.names, bad, strict=True) if negative and name.startswith(_POSITIVE)
    )
