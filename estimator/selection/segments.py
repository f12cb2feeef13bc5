"""Validation of fits to segments: missing terms, standard errors that allow for them, and prediction of held-out
motion.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ALL, Shooting, ShootingEstimate
from hil.estimator.fit.reparametrisation import Sizes
from hil.estimator.models.terms import Option, term_of
from hil.estimator.options import ShootingOptions
from hil.estimator.selection.candidates import Candidate, Linearised, colour, ranked, richer_models, unruled, widened

NOT_HERE: tuple[Option, ...] = ("zeros", "encoder", "ripple", "cogging")
"""Options that multiple shooting replaces (with the zeros of each recording) or does not support."""
COARSE = ShootingOptions().coarse_step
KNOWN_SHARE = 1.0 / 3.0  # fraction of a held-out segment that determines its initial state; the rest is predicted
STATE_STEPS = 6
FEWEST_ROWS = 3  # minimum number of samples per unknown of the initial state


def missing_terms(recordings: Sequence[Recording], estimate: ShootingEstimate) -> list[Candidate]:
    """Return the terms that could be added to the estimate's model, most significant first according to score tests."""
    richer = {part: more for part, more in richer_models(estimate.model).items() if part not in NOT_HERE}
    names = {name for more in richer.values() for name in more.names if name not in estimate.names}
    return ranked(linearised(recordings, estimate, sorted(names)), estimate.names, richer, {})


def considered(recordings: Sequence[Recording], estimate: ShootingEstimate) -> ShootingEstimate:
    """Return the estimate with standard errors that account for omitted terms that cannot be ruled out."""
    left_out = [name for name in unruled(estimate.model) if term_of(name).part not in NOT_HERE]
    if not left_out:
        return estimate
    about = linearised(recordings, estimate, left_out)
    return replace(estimate, covariance=widened(about, estimate.names, estimate.covariance, left_out))


def linearised(recordings: Sequence[Recording], estimate: ShootingEstimate, names: Sequence[str]) -> Linearised:
    """Return the quadratic approximation of the weighted sum of squares about `estimate`.

    Its variables are the parameters and the encoder zeros of each recording.

    The segments' initial states are eliminated. names: additional parameters, expanded about the values at which they
    have no effect.
    """
    problem = _posed(recordings, estimate)
    every = (*estimate.names, *(name for name in names if name not in estimate.names))
    values = {name: term_of(name).absent for name in every} | estimate.parameters
    causes = len(every) + problem.zeros
    normal, gradient = np.zeros((causes, causes)), np.zeros(causes)
    offsets = estimate.zeros.reshape(-1) / ShootingOptions().angle_scale
    size = np.maximum(estimate.residual_over_noise, 1e-12)[:, None]
    correlation, samples = [], 0
    for number, own in enumerate(estimate.own):
        rows, columns = problem.derivative_by_values(number, values, offsets, own, every)
        shape = problem.segments[number].position.shape
        weight = np.broadcast_to(1.0 / size, shape).reshape(-1)
        r, J = rows * weight, columns * weight[:, None]
        mine, state = J[:, :causes], J[:, causes:]
        # Changes that the segment's initial state explains carry no information about the parameters.
        Q = linalg.qr(state)[0]
        mine, r = mine - Q @ (Q.T @ mine), r - Q @ (Q.T @ r)
        normal += mine.T @ mine
        gradient += mine.T @ r
        samples += int(np.count_nonzero(rows))
        correlation.append(colour(r.reshape(shape)))
    sizes = _sizes(recordings, estimate)
    spread = np.array([np.inf if term_of(n).spread is None else sizes.of(term_of(n).spread or 1.0) for n in every])
    return Linearised(
        every,
        np.array([values[name] for name in every]),
        normal,
        gradient,
        samples,
        float(np.median(correlation)),
        1.0 / spread**2,
    )


def held_out_errors(
    recordings: Sequence[Recording], estimate: ShootingEstimate, of: slice = ALL
) -> tuple[Array, float]:
    """Return the RMS error of predicted segments relative to the motion's RMS (joints,), and the segments' median
    error.

    The initial state of a segment is estimated from its first third; the rest is predicted from the torque alone. The
    median over the segments is robust to the huge errors of a tumbling arm. A prediction that diverges counts as an
    error of half a turn.
    """
    problem = _posed(recordings, estimate, of)
    values, joints = estimate.parameters, estimate.model.joints
    offsets = estimate.zeros.reshape(-1) / ShootingOptions().angle_scale
    motion = np.sqrt(np.mean([np.var(each.filled(), axis=1) for each in recordings], axis=0))
    squares, counts = [], []
    for number, segment in enumerate(problem.segments):
        shape = segment.position.shape
        measured = np.isfinite(segment.position)
        early = measured & (np.arange(shape[1]) < max(KNOWN_SHARE * shape[1], FEWEST_ROWS * 2 * joints))
        own = (segment.state / problem.state_scale).reshape(-1)
        for _ in range(STATE_STEPS):
            rows, columns = problem.derivative_by_values(number, values, offsets, own, ())
            known = early.reshape(-1)
            r, J = rows[known], columns[known, -own.size :]
            if not (np.isfinite(r).all() and np.isfinite(J).all()):
                break  # the simulated arm diverges: its prediction is as wrong as possible
            step = linalg.lstsq(J, r, rcond=None)[0]
            own = own - np.clip(step, -1.0, 1.0)
            if float(np.abs(step).max()) < 1e-4:
                break
        rows, _ = problem.derivative_by_values(number, values, offsets, own, ())
        error = np.clip(np.nan_to_num(rows.reshape(shape) * problem.noise, nan=np.pi), -np.pi, np.pi)
        later = measured & ~early
        squares.append(np.sum(np.where(later, error, 0.0) ** 2, axis=1))
        counts.append(np.maximum(later.sum(axis=1), 1))
    relative = np.array(squares) / np.array(counts) / motion**2
    whole = np.sqrt(np.sum(squares, axis=0) / np.sum(counts, axis=0)) / motion
    return np.asarray(whole), float(np.median(np.sqrt(np.mean(relative, axis=1))))


def predicted_positions(recordings: Sequence[Recording], estimate: ShootingEstimate) -> tuple[Array, ...]:
    """Return the simulated positions of each recording (joints, samples) [rad]; NaN outside the fitted segments."""
    problem = _posed(recordings, estimate)
    offsets = estimate.zeros.reshape(-1) / ShootingOptions().angle_scale
    predicted = tuple(np.full(each.position.shape, np.nan) for each in recordings)
    for segment, own in zip(problem.segments, estimate.own, strict=True):
        found = problem.position_by_values(segment, estimate.parameters, offsets, own)
        predicted[segment.recording][:, segment.samples] = found
    return predicted


def _posed(recordings: Sequence[Recording], estimate: ShootingEstimate, of: slice | None = None) -> Shooting:
    chosen = estimate.fitted if of is None else of
    return Shooting(
        recordings,
        estimate.model,
        estimate.segment_length,
        zeros=estimate.zeros.size > 0,
        of=chosen,
        step=COARSE,
    )


def _sizes(recordings: Sequence[Recording], estimate: ShootingEstimate) -> Sizes:
    torque = float(np.sqrt(np.mean([np.mean(each.torque**2) for each in recordings])))
    speed = [np.diff(each.filled(), axis=1) / np.diff(each.time) for each in recordings]
    velocity = float(np.sqrt(np.mean([np.mean(each**2) for each in speed])))
    return Sizes(torque, velocity, abs(estimate.parameters["inertia_1"]))
