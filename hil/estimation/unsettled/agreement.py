"""Check whether recordings come from the same arm, so that a change of load is not mistaken for a missing term."""

from collections.abc import Sequence

import numpy as np

from hil.estimator.data.recording import Recording
from hil.estimator.errors import EstimationError
from hil.estimator.fit.multiple_shooting import ShootingEstimate, estimate_by_shooting
from hil.estimator.models.terms import kind_of

UNEXPLAINED = 1.5  # ratio of residual to noise above which the recordings are compared
MUCH_BETTER = 0.5  # largest residual of separate fits, relative to that of the common one
APART = 4.0  # standard deviations between the values of two recordings
NAMED = 3  # number of parameters named in the message
MOST = 8  # maximum number of recordings, since each is fitted once more


def disagreement(
    recordings: Sequence[Recording],
    names: Sequence[str],
    estimate: ShootingEstimate,
    segment: float,
    zeros: bool,
) -> tuple[str, ...]:
    """A sentence if separate fits explain the recordings much better than a common fit does; () otherwise.

    The encoder zeros are treated as unknown if the common estimate includes them.
    """
    left = float(estimate.residual_over_noise.max())
    if not 1 < len(recordings) <= MOST or left <= UNEXPLAINED:
        return ()
    alone = _separately(recordings, estimate, segment, zeros)
    if alone is None or max(float(each.residual_over_noise.max()) for each in alone) > MUCH_BETTER * left:
        return ()
    called = names if len(names) == len(recordings) else [f"recording {k + 1}" for k in range(len(recordings))]
    worst = max(float(each.residual_over_noise.max()) for each in alone)
    differs = _differences(alone, called)
    return (
        f"The recordings disagree: separate fits leave residuals of at most {worst:.1f} times the noise, but a common "
        f"fit leaves {left:.1f} times the noise{': ' if differs else ''}{'; '.join(differs)}. Did the load, the "
        "mounting or a setting change between the recordings? Estimate each separately.",
    )


def _separately(
    recordings: Sequence[Recording], estimate: ShootingEstimate, segment: float, zeros: bool
) -> list[ShootingEstimate] | None:
    base = estimate.value[: len(estimate.model.base_names)]
    try:
        return [estimate_by_shooting([each], estimate.model, base, length=segment, zeros=zeros) for each in recordings]
    except EstimationError:
        return None


def _differences(alone: Sequence[ShootingEstimate], names: Sequence[str]) -> list[str]:
    """The base parameters whose values differ most, in standard deviations, each with its lowest and highest value."""
    found = []
    for index, name in enumerate(alone[0].model.base_names):
        if kind_of(name) == "offset":
            continue
        value = np.array([each.value[index] for each in alone])
        std = np.array([each.std[index] for each in alone])
        low, high = int(np.argmin(value)), int(np.argmax(value))
        away = float((value[high] - value[low]) / np.hypot(std[low], std[high]))
        if away > APART:
            found.append((away, f"{name} is {value[low]:.4g} in {names[low]} and {value[high]:.4g} in {names[high]}"))
    return [said for _, said in sorted(found, reverse=True)[:NAMED]]
