"""The verdict on a spatial arm estimated from other tools' recordings, with its reasons."""

from collections.abc import Iterator, Sequence

import numpy as np

from hil.description.arm import ArmDescription
from hil.estimation.chain_estimate import stopped_short, vague
from hil.estimation.chain_mount import MountDoubt, mass_on_the_other_side, mounted_otherwise
from hil.estimation.torque_constants import contradictions, ratios_of, ratios_said
from hil.estimation.unsettled.chain_changes import ChangedColumns
from hil.estimator.arrays import Array
from hil.estimator.chain.identify import SYSTEMATIC
from hil.estimator.chain.model.chain_model import ChainModel
from hil.estimator.chain.model.prior import Prior
from hil.estimator.chain.mount import LIKELY, SURE, opposed_moments
from hil.estimator.chain.recordings import RecordedChain
from hil.estimator.models.bounds import bound_sentence
from hil.estimator.models.conflicts import Trust, conflict_sentences, contradicted, lowered
from hil.estimator.selection.verdict import MUCH_LEFT
from hil.results.parts import Verdict

__all__ = ["FITTED_SHARES", "chain_verdict"]

FITTED_SHARES = (0.75, 0.6, 0.5)
"""Fraction of each recording that is fitted; the rest serves as a check. The first one for which every joint moves in
both parts is used.
"""
EXPLAINED = 1.2  # ratio of residual to noise up to which the model counts as complete
TORQUE_FORETOLD, TORQUE_WRONG = 0.1, 0.3  # relative torque error on the last part: limits for yes and no
TORQUE_UNEXPLAINED = 0.1  # limit for rejecting a model that leaves part of the motion unexplained

Judgement = tuple[str, Sequence[str]]
"""The most favourable verdict that one aspect allows ("" if it allows any), and sentences about it."""


def chain_verdict(
    found: RecordedChain,
    arm: ArmDescription,
    foretold: Array | None,
    prior: Prior,
    contradictory: Sequence[str] = (),
    late: Sequence[str] = (),
    sticking: Sequence[int] = (),
    gravity: Array | None = None,
    changed: ChangedColumns | None = None,
    fitted_share: float = FITTED_SHARES[0],
) -> Verdict:
    """The verdict, with reasons.

    foretold: relative torque error on the last part of the recordings (joints,); None without one. contradictory, late:
    sentences about torques that contradict each other in the regression, or are logged late. sticking: joints that
    stick, numbered from 0. gravity: see `better_gravity_recorded`. changed: the mistake in the columns, if it is known;
    advice that assumes sound columns is then withheld. fitted_share: fraction of the recordings to which the model was
    fitted for `foretold`.
    """
    names = found.model.base.names
    weakest = names[int(np.argmax(found.std[: len(names)] / prior.std))]
    explained = _is_explained(found)
    mount = (
        _doubted_mount(found, arm, prior, gravity, explained)
        if changed is None
        else MountDoubt("with care" if explained else "no", changed.said(arm.path.name), changed.remedy)
    )
    cause = _cause(gravity, changed)
    judgements = (
        *(_of_residual(found, arm, cause) if found.simulated else (_AS_MEASURED,)),
        _of_prediction(foretold, fitted_share, arm, explained, bool(cause))
        if foretold is not None
        else _without_prediction(found),
        *_of_values(found, prior, bool(cause)),
        (contradicted(found.conflicts, explained), () if cause else conflict_sentences(found.conflicts, explained)),
        *_of_torques(found, arm, contradictory, late),
        _of_convergence(found, arm, () if cause else sticking),
        ("", ()) if mount is None else (mount.at_most, mount.said),
    )
    trust: Trust = "yes"
    for at_most, _ in judgements:
        trust = lowered(trust, at_most)
    sentences = tuple(sentence for _, said in judgements for sentence in said)
    return Verdict(trust, weakest, sentences) if mount is None else Verdict(trust, weakest, sentences, mount.first)


_AS_MEASURED: Judgement = (
    "with care",
    (
        "The torque columns were treated as measurements, so the result comes from a regression; its errors are "
        'partly systematic. If the columns hold commands, set columns.between = "held": maximum likelihood is then '
        "far more accurate.",
    ),
)


def _is_explained(found: RecordedChain) -> bool:
    """Whether nothing in the motion remains unexplained; a regression alone does not reveal missing effects."""
    return not found.simulated or (
        float(found.residual_over_noise.max()) <= EXPLAINED and found.systematic <= SYSTEMATIC
    )


def _cause(gravity: Array | None, changed: ChangedColumns | None) -> str:
    """Say what is wrong, if the verdict names it; "" if it does not. gravity: see `better_gravity_recorded`."""
    if changed is not None:
        return "the columns are not as configured"
    return "" if gravity is None else "the arm is not mounted as configured"


def _of_residual(found: RecordedChain, arm: ArmDescription, cause: str) -> Iterator[Judgement]:
    worst = float(found.residual_over_noise.max())
    joint = arm.joints[int(np.argmax(found.residual_over_noise))].name
    said = f"The largest residual ({joint}) is {worst:.2f} times the noise of that joint's angle."
    yield "" if worst <= EXPLAINED else "with care", (said,)
    if found.systematic > SYSTEMATIC:
        said = (
            "Part of the residual repeats with the motion. This increases standard errors by a factor of up to "
            f"{found.systematic:.1f}, and some values may be wrong by more than their standard errors. "
            f"{_missing(found.model, cause)}"
        )
        yield "with care", (said,)


def _of_values(found: RecordedChain, prior: Prior, is_cause_known: bool) -> Iterator[Judgement]:
    """Judge values that come from the description, that are uncertain, or that ended at a bound.

    is_cause_known: whether the verdict names the mistake that distorts them.
    """
    if found.from_prior:
        of_file = ", ".join(found.from_prior)
        yield "with care", (f"The recordings reveal little about {of_file}: these values come from the URDF.",)
    if said := vague(prior, found.model.base.names, found.std, found.from_prior):
        yield "with care", (said,)
    if found.at_bound:
        yield "with care", () if is_cause_known else (bound_sentence(found.at_bound),)


def _of_torques(
    found: RecordedChain, arm: ArmDescription, contradictory: Sequence[str], late: Sequence[str]
) -> Iterator[Judgement]:
    joints, ratios = [joint.name for joint in arm.joints], ratios_of(found.names, found.value, found.std)
    differ = contradictions(joints, ratios, {}, "column", found.conflicts)
    yield "with care" if differ else "", (*differ, *ratios_said(joints, ratios, "column", differ))
    yield "with care" if late else "", late
    if contradictory and not found.simulated:
        yield "no", contradictory


def _of_convergence(found: RecordedChain, arm: ArmDescription, sticking: Sequence[int]) -> Judgement:
    if found.reached:
        return "", ()
    return "with care", (stopped_short([arm.joints[joint].name for joint in sticking], "Record faster motion"),)


def _doubted_mount(
    found: RecordedChain, arm: ArmDescription, prior: Prior, gravity: Array | None, explained: bool
) -> MountDoubt | None:
    """Return the contradiction between the centres of mass and the description, if there is one."""
    sure = SURE if gravity is None else LIKELY
    opposed = opposed_moments(found.names, found.value, found.std, prior, sure)
    if gravity is None:
        return mass_on_the_other_side(arm, opposed, explained, is_run=False)
    return mounted_otherwise(arm, opposed, found.model.base.chain.gravity, gravity, explained, is_run=False)


def _missing(model: ChainModel, cause: str) -> str:
    """Say why part of the motion is unexplained. cause: see `_cause`."""
    if cause:
        return f"The model is incomplete, probably because {cause}."
    lags = ', lags that differ by joint (model.drive = "delay_lag")' if model.drive == "delay" else ""
    return (
        "An effect is missing from the model: torque ripple or cogging, play or elasticity of the gears, a cable, "
        f"friction that depends on load or changes with time{lags}, or torques that differed from the commands."
    )


def _without_prediction(found: RecordedChain) -> Judgement:
    said = (
        "The recordings are too short, or their joints move in too small a part of them, to check the prediction on a "
        "part that was not fitted."
    )
    left = float(found.residual_over_noise.max()) if found.simulated else 0.0
    if left <= MUCH_LEFT:
        return "with care", (said,)
    return "no", (said, f'Without that check, a residual above {MUCH_LEFT:g} times the noise makes the verdict "no".')


def _of_prediction(
    foretold: Array, fitted_share: float, arm: ArmDescription, explained: bool, is_cause_known: bool
) -> Judgement:
    """The best verdict that the prediction of the last part allows ("" for any), and why.

    is_cause_known: whether the verdict names the cause.
    """
    error, wrong = float(np.nanmax(foretold)), TORQUE_WRONG if explained else TORQUE_UNEXPLAINED
    said = _foretold_said(error, fitted_share, arm.joints[int(np.nanargmax(foretold))].name)
    if error <= wrong:
        return "with care" if error > TORQUE_FORETOLD else "", (said,)
    unexplained = "" if explained else " together with an unexplained part of the motion"
    check = (
        ": check which column belongs to which joint, the units and signs of the columns, whether the load changed, "
        "and the description of the arm"
    )
    check = "" if is_cause_known else check
    return "no", (said, f'An error above {100 * wrong:.0f} %{unexplained} makes the verdict "no"{check}.')


def _foretold_said(error: float, fitted_share: float, joint: str) -> str:
    """Describe how well the last part is predicted. error: relative to the RMS torque. joint: the joint with it."""
    part = f"the torque in the last {100 * (1 - fitted_share):.0f} % of each recording"
    if error > 1.0:
        return (
            f"When fitted to the rest, the model cannot predict {part}: the error is {error:.2g} times the "
            f"torque's own RMS (worst joint: {joint})."
        )
    return (
        f"When fitted to the rest, the model predicts {part} to within {100 * error:.1f} % of the torque's RMS (worst "
        f"joint: {joint})."
    )
