"""Options of stage 2 for chains, the maximum-likelihood fit."""

from dataclasses import dataclass

from hil.estimator.options import CoordinateOptions


@dataclass(frozen=True)
class ChainOptions:
    """Options of stage 2 for chains; those shared with `hil.estimator.options` have the same names."""

    softness: tuple[float, ...] = (3.0, 1.5, 1.0)
    """Natural frequencies of the observer, in order of use [Hz].

    A softer observer extracts more information; one that is too soft no longer follows the motion.
    """
    lost: float = 1.5
    """A softer observer is rejected if the cost grows by more than this multiple of the growth that its softness alone
    would cause.
    """
    first_step: float = 5.2e-3
    """Integration step while the observer is stiff [s]; samples within such a step are skipped."""
    coarse_step: float = 2.6e-3
    """Integration step of the iterations between the first ones (`first_step`) and the last ones (`fine_step`) [s]."""
    fine_step: float = 1.3e-3
    """Integration step of the last iterations [s]."""
    finer: int = 16
    """Number of smaller steps into which a step near standstill is divided, since friction changes rapidly there."""
    finest: int = 64
    """Number of smaller steps into which a step near standstill is divided in the last iterations."""
    widths_per_substep: float = CoordinateOptions.widths_per_substep
    width_floor: float = 3e-4
    """Minimum width of every Coulomb step [rad/s]; a step this narrow is hardly distinguishable from true sticking."""
    initial_width: float = 0.03
    """Initial width of the smoothed Coulomb step [rad/s]."""
    other_initial_widths: tuple[float, ...] = (0.005, 0.001)
    """Initial widths for further fits, tried in turn until one explains the motion [rad/s]."""
    far: float = 3.0
    """RMS residual of the worst joint, relative to its noise, above which the fit is repeated: first with free encoder
    zeros, then, from there, without them.
    """
    poor: float = 1.2
    """RMS weighted residual above which a second initial guess is tried; 1 for noise alone."""
    test_zeros: bool = False
    """Whether to test the encoder zeros that the model holds fixed; this takes one more simulation with sensitivities.
    """
    min_initial_lag: float = 5e-4
    """Minimum initial guess of the lag [s]."""
    reach: float = 0.3
    """Fraction of the maximum change per step that friction-shape parameters may use in the last iterations.

    The sum of squares is far from quadratic in these parameters.
    """
    ftol_coarse: float = 1e-2
    ftol_near: float = 3e-3
    ftol_nearer: float = 1e-3
    ftol: float = 2e-5
    towards_prior: tuple[float, ...] = (1.0, 0.7, 0.4, 0.2, 0.0)
    """Initial guesses, as fractions of the way from the prior to stage 1's result; the first feasible one is used."""
    unfinished: float = 1.0
    """If one more step is expected to decrease the sum of squares by more than this, the minimum has not been reached,
    and the fit continues with shorter integration steps. A decrease of 1 corresponds to a distance of one standard
    error.
    """
    angle_scale: float = 0.1
    """Scale of the initial angles [rad]."""
    outlier_threshold: float = 4.0
    """Residual in standard deviations above which a sample is downweighted."""


DEFAULTS = ChainOptions()
