"""Position jumps that the velocity does not explain: an encoder slipped, or a horn moved on its shaft.

The guard stops a run at once if a position changes by more than the joint can move; a smaller jump merely shifts all
later readings.
"""

import numpy as np
from numpy.typing import NDArray

from hil.config.schema import Config
from hil.estimator.arrays import Array
from hil.runs.recording import Phase
from hil.runs.run_folder import RunFacts

LEAST_STEPS = 8.0  # smallest jump that is reported, in encoder steps
USUAL_QUANTILE = 0.995
FAR_OUTSIDE = 4.0  # minimum size of a jump, as a multiple of the usual difference
AROUND_S = 0.03  # s; time on either side in which a delayed or filtered velocity catches up with a real motion
KEPT = 0.6  # fraction of a jump that must remain after that time; otherwise, it is a bad reading or a real motion
LONGEST_GAP = 5.0  # sample intervals
FEWEST = 200  # samples


def jump_warnings(config: Config, facts: RunFacts, samples: NDArray[np.void]) -> list[str]:
    """One sentence per joint whose position jumped."""
    found = []
    for index, jumps in enumerate(_jumps(config, facts, samples)):
        if not jumps:
            continue
        time, size = max(jumps, key=lambda jump: abs(jump[1]))
        others = f" ({len(jumps)} jumps in all)" if len(jumps) > 1 else ""
        found.append(
            f"{config.joints[index].name}: the position jumped by {size:+.3f} rad "
            f"({abs(size) / facts.position_step[index]:.0f} encoder steps) at {time:.2f} s{others}. The velocity "
            "before and after the jump does not explain it; all later positions are shifted. Check the horn's screws, "
            "the encoder's magnet and the cable, then record again."
        )
    return found


def jump_disturbances(config: Config, facts: RunFacts, samples: NDArray[np.void]) -> tuple[str, ...]:
    """Name the joints whose position jumped, in a sentence for the verdict; () if there are none.

    Jumps after the last multisine are ignored: nothing after it is used.
    """
    used = np.flatnonzero(samples["phase"] == Phase.PERIODIC)
    found = zip(config.joints, _jumps(config, facts, samples[: used[-1] + 1 if used.size else 0]), strict=True)
    names = [joint.name for joint, jumps in found if jumps]
    if not names:
        return ()
    return (
        f"The position of {' and '.join(names)} jumped during the recording (see the warning), so angles before and "
        "after the jump are inconsistent: the values may be wrong by more than their standard errors.",
    )


def _jumps(config: Config, facts: RunFacts, samples: NDArray[np.void]) -> list[list[tuple[float, float]]]:
    begin = float(samples["deadline"][0]) if len(samples) else 0.0
    return [
        position_jumps(
            samples["deadline"] - begin,
            samples["position"][:, index].astype(np.float64),
            samples["velocity"][:, index].astype(np.float64),
            facts.position_step[index],
        )
        for index in range(len(config.joints))
    ]


def position_jumps(time: Array, position: Array, velocity: Array, step: float) -> list[tuple[float, float]]:
    """Find jumps: differences between position and integrated velocity far larger than usual. Returns times [s] and
    sizes [rad].

    Args:
        time: sampling times (samples,) [s].
        position: measured angles (samples,) [rad]; NaN where a reply is missing.
        velocity: velocities reported by the servo (samples,) [rad/s].
        step: encoder step [rad].
    """
    read = np.isfinite(position) & np.isfinite(velocity)
    time, position, velocity = time[read], position[read], velocity[read]
    if len(time) < FEWEST:
        return []
    elapsed = np.diff(time)
    interval = float(np.median(elapsed))
    unexplained = np.diff(position) - 0.5 * (velocity[1:] + velocity[:-1]) * elapsed
    # Across lost samples, the velocity's curvature matters: the next term of the Euler-Maclaurin formula.
    curved = elapsed**2 / 12.0 * np.diff(np.gradient(velocity, time))
    unexplained += np.where(elapsed > 1.5 * interval, curved, 0.0)
    unexplained[elapsed > LONGEST_GAP * interval] = 0.0
    # A velocity that is delayed by a constant time leaves a difference proportional to its change.
    change = np.diff(velocity)
    unexplained -= change * float(unexplained @ change) / max(float(change @ change), 1e-12)
    usual = float(np.quantile(np.abs(unexplained), USUAL_QUANTILE))
    # The motion across lost samples is less certain.
    threshold = max(LEAST_STEPS * step, FAR_OUTSIDE * usual) * np.maximum(1.0, (elapsed / interval) ** 2)
    around = max(2, round(AROUND_S / interval))
    found = []
    for place in np.flatnonzero(np.abs(unexplained) > threshold).tolist():
        near = slice(max(0, place - around), place + around + 1)
        remains = float(unexplained[near].sum()) / float(unexplained[place])
        if KEPT < remains < 2.0 - KEPT:
            found.append((float(time[place + 1]), float(unexplained[place])))
    return found
