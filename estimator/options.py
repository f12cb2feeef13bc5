"""What a fit may be told: tolerances, limits and initial guesses, gathered in one frozen object for each fit.

Names follow scipy.optimize: `ftol` is the relative decrease of the sum of squares below which a fit has converged,
`max_iterations` how long it may take. The defaults are what every figure of this project was measured with.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class IntegrationOptions:
    """Of the simulation in `hil.estimator.simulation.arm`."""

    max_step: float = 0.85e-3
    """[s]"""
    max_substeps: int = 64
    """Into which one step may be cut where a joint is near standstill."""


@dataclass(frozen=True)
class MinimiserOptions:
    """Options of Levenberg-Marquardt in coordinates of order 1."""

    max_iterations: int = 60
    max_step: float = 2.0
    """Largest change of one coordinate in one iteration."""
    unfinished: float = 1e-2
    """After `max_iterations` a relative decrease below this still counts as converged."""
    initial_damping: float = 1e-3
    """Of the squared length of each coordinate's column."""
    min_damping: float = 1e-9
    max_damping: float = 1e3


@dataclass(frozen=True)
class SegmentedMinimiserOptions:
    """Of Levenberg-Marquardt with unknowns of each segment."""

    max_iterations: int = 80
    max_step: float = 2.0
    """Largest change of one coordinate in one iteration."""
    unfinished: float = 1e-3
    """After `max_iterations` a relative decrease below this still counts as converged."""
    initial_damping: float = 1e-3
    min_damping: float = 1e-8
    max_damping: float = 1e5


@dataclass(frozen=True)
class CoordinateOptions:
    """Of the likelihood's coordinates, which keep parameters in their range."""

    width_floor: float
    """What the width of every Coulomb step stays above [rad/s]."""
    min_initial: float = 1e-3
    """Of its scale: the least that a positive parameter starts with."""
    max_initial_share: float = 0.95
    """Of its bound, which the parameter may start with if it is a share of two others."""
    min_width: float = 1e-3
    """Of the floor: what a width always keeps above it, or no step would lead back."""
    max_relative_increase: float = 2.0
    """Of a width, in one iteration."""


@dataclass(frozen=True)
class LinearOptions:
    """Of stage 1, the regression on Fourier lines."""

    coulomb_width: float = 0.05
    """About the velocity that the dropped lines leave in a sticking joint [rad/s]."""
    max_condition: float = 1e8


@dataclass(frozen=True)
class CovarianceOptions:
    """Of the standard errors under correlated residuals."""

    max_lag: int = 400
    """Samples."""
    max_lag_share: float = 0.05
    """Of a run."""
    min_lag: int = 4
    """Samples."""
    min_window_share: float = 0.005
    """Of a run: rounding is correlated, a little, over more lags than its autocorrelation shows."""


@dataclass(frozen=True)
class LikelihoodOptions:
    """Of stage 2, the maximum likelihood of settled periods.

    Sums of squares are in units of the noise: 1 per sample is noise alone.
    """

    ftol: float = 1e-5
    """At the end: what is left to gain is a tenth of a standard error's worth over all parameters together."""
    ftol_refine: float = 3e-4
    """While minima are told apart."""
    ftol_start: float = 3e-3
    """From one initial guess."""
    ftol_coarse: float = 2e-2
    """Where only the neighbourhood of a minimum is wanted: of a coarse fit, of the tracking fit."""
    ftol_state: float = 0.1
    """Of the first state alone."""

    coordinates: CoordinateOptions = CoordinateOptions(width_floor=1e-4)
    """Friction that sticks is not told from a width of 1e-4 rad/s, and from 3e-4 by half a standard error."""
    minimiser: MinimiserOptions = MinimiserOptions()
    integration: IntegrationOptions = IntegrationOptions()
    coarse_integration: IntegrationOptions = IntegrationOptions(max_step=2.6e-3, max_substeps=16)
    """Off by a few hundredths of an encoder step, for a third of the time."""
    covariance: CovarianceOptions = CovarianceOptions()

    initial_widths: tuple[float, ...] = (0.005, 0.05)
    """Of the Coulomb step [rad/s]. From a narrow step the fit of a wide one may end in a local minimum, and the other
    way round: every one is tried."""
    initial_bends: tuple[float, ...] = (1e-3, 5e-3)
    """How far friction with presliding bends before it slides [rad], one for each of `initial_widths`."""
    min_initial_lag: float = 1e-4
    """[s]"""
    angle_scale: float = 0.1
    """[rad]"""

    tracking_frequency: float = 2.0
    """[Hz] that springs to the measured motion would give each joint. An arm that swings past the upright amplifies
    what is still wrong: it is held to the measured motion first."""
    tracking_loss: float = 1.5
    """Where the free motion leaves so many times more than the tracking one, the arm's free beginning is fitted before
    the whole."""
    horizons: tuple[float, ...] = (0.125, 0.25, 0.5)
    """Shares of the run that this beginning has, one after the other."""
    min_horizon_samples: int = 10
    """Samples per unknown over all joints; a shorter beginning is skipped."""

    max_relative_decrease: float = 0.8
    """Of a Coulomb width in one iteration: in fine steps, near the minimum, the sum is nearly quadratic in it."""
    max_relative_decrease_coarse: float = 0.5
    """The same far from the minimum, where it is anything but."""

    same_cost: float = 1.0
    """Minima whose sums of squares are this close count as the same."""
    close_cost: float = 25.0
    """Minima this close are distinguished only with fine steps."""
    explained_cost: float = 1.03
    """Per sample: below this no further initial guess is tried."""
    hopeless_cost: float = 2.0
    """Per sample: a coarse fit with a larger residual is abandoned."""
    refine_ratio: float = 1.01
    """Relative to the best sum of squares: up to this ratio another try may still end lower."""
    outlier_threshold: float = 4.0
    """Standard deviations from which a sample is downweighted; rounding never leaves more than 1.7."""
    threads: int = 8
    """Maximum number of parallel tries; the result does not depend on it."""


@dataclass(frozen=True)
class ShootingOptions:
    """Of multiple shooting on any recording."""

    ftol: float = 3e-5
    ftol_refine: float = 1e-3
    """Of fits between which segments are downweighted."""
    ftol_start: float = 1e-2
    """Of those that only lead near a minimum."""
    max_step: float = 1e-3
    """Of the integration, in the last fit [s]."""
    coarse_step: float = 2.6e-3
    """In the fits before: off by a few hundredths of a standard error, for a third of the time [s]."""
    start_segments: int = 80
    """That many of the segments, evenly chosen, lead near a minimum."""
    coordinates: CoordinateOptions = CoordinateOptions(width_floor=3e-3)
    """A width below 3e-3 rad/s costs much time and is not seen in a second of motion."""
    minimiser: SegmentedMinimiserOptions = SegmentedMinimiserOptions()
    initial_width: float = 0.05
    """Of the Coulomb step [rad/s]."""
    initial_bend: float = 0.003
    """How far friction with presliding bends before it slides [rad]."""
    initial_stribeck_velocities: tuple[float, ...] = (0.2, 2.0)
    """[rad/s], each of which is tried."""
    short: float = 0.25
    """Of the segments' length: the segments that come first."""
    angle_scale: float = 0.1
    """[rad]"""
    reweightings: int = 2
    """Fits after the first, each with segments downweighted by their residual in the one before."""


@dataclass(frozen=True)
class CalibrationOptions:
    """Of the joint likelihood of two periods, without and with a known mass."""

    ftol: float = 1e-6
    coordinates: CoordinateOptions = CoordinateOptions(width_floor=3e-4)
    minimiser: MinimiserOptions = MinimiserOptions()
    initial_width: float = 0.005
    """Of the Coulomb step [rad/s]: under a wrong torque constant the first estimate's is worth nothing."""
    angle_scale: float = 0.1
    """[rad]"""
    difference: float = 1e-6
    """Of a coordinate, in finite differences."""


@dataclass(frozen=True)
class SettlingOptions:
    """Of a simulation that goes on until the motion is periodic."""

    max_periods: int = 50
    atol: float = 1e-7
    """[rad and rad/s] from one period's end to the next."""
    acceptable: float = 1e-5
    """Accepted after `max_periods`: far below any encoder step."""


@dataclass(frozen=True)
class SelectionOptions:
    """Options for choosing a friction model by held-out error."""

    keep_ratio: float = 0.98
    """Of the error of the best model so far: what a richer one must reach to be kept."""
    explained_error: float = 1.05
    """RMS error of the prediction in units of the noise: nothing is left for another term."""
    explained_residual: float = 1.02
    """RMS residual in units of the noise: likewise."""
    near_residual: float = 5.0
    """The same below which a richer model's minimum is sought near the plainer one's."""
    presliding_residual: float = 1.2
    """The same from which presliding is tried, whose fit takes long."""
    initial_widths: tuple[float, ...] = (5e-4, 2e-2)
    """Of the Coulomb step of one joint, tried where the motion is not explained [rad/s]."""
    overrule_ratio: float = 0.8
    """Of the chosen model's error of prediction: what another one must reach to be chosen instead."""
    ripple_cycles: tuple[float, ...] = tuple(0.5 * n for n in range(6, 33)) + tuple(float(n) for n in range(17, 41))
    """A turn: where ripple is looked for."""
    ripple_evidence: float = 0.05
    """Of the score test, from which ripple is tried: where it repeats is found roughly, so that a fit sees more."""
    prune_levels: tuple[float, ...] = (1e-3, 0.1)
    """Significance levels, tried in turn until the motion is explained as well."""
