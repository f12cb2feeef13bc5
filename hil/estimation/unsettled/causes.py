"""Why a fit leaves much of the motion unexplained, if the recording itself shows it."""

from collections.abc import Sequence

from hil.estimation.unsettled.local_defects import Array, local_defects, local_residual
from hil.estimator.baselines.torque_faults import suspect_clipped, suspect_drift
from hil.estimator.data.recording import Recording
from hil.estimator.fit.multiple_shooting import ShootingEstimate
from hil.estimator.selection.verdict import MUCH_LEFT


def causes(
    recordings: Sequence[Recording], names: Sequence[str], predicted: Sequence[Array], estimate: ShootingEstimate
) -> tuple[str, ...]:
    """Sentences on the cause: a local defect, a clipped torque or a clock that drifts; otherwise, where the residual is
    large.

    predicted: simulated positions of each recording (joints, samples) [rad].
    """
    if float(estimate.residual_over_noise.max()) <= MUCH_LEFT:
        return ()
    where = recordings, names, predicted, estimate.segment_length
    return local_defects(*where) or _clipped(recordings) or _drifting(recordings) or local_residual(*where)


def _clipped(recordings: Sequence[Recording]) -> tuple[str, ...]:
    return tuple(
        f"The torque of joint {each.joint} seems to have been limited to about {each.level:.3g} N m; its column "
        f"exceeds that in {100 * each.beyond:.2g} % of the samples. With this limit, inverse dynamics leaves "
        f"{100 * each.residual:.2g} % of the torque unexplained instead of {100 * each.residual_given:.2g} %. A "
        "current limit or the supply voltage clips it (saturation): use the measured current, or smaller commands."
        for each in suspect_clipped(recordings)
    )


def _drifting(recordings: Sequence[Recording]) -> tuple[str, ...]:
    drift = suspect_drift(recordings)
    if drift is None:
        return ()
    return (
        f"The delay of the torque drifts from {1e3 * drift.start:+.3g} ms to {1e3 * drift.end:+.3g} ms over the "
        f"recording ({1e6 * drift.relative:+.0f} ppm): with this drift, inverse dynamics leaves "
        f"{100 * drift.residual:.2g} % of the torque unexplained instead of {100 * drift.residual_given:.2g} %. Torque "
        "and position were timed by different clocks: correct the times of one, or log both with the same clock.",
    )
