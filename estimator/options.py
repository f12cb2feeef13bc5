"""Options of the fits: tolerances, limits and initial guesses, in one frozen object per fit.

Names follow scipy.optimize: `ftol` is the relative decrease in the sum of squares below which a fit has converged,
`max_iterations` the maximum number of iterations.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class IntegrationOptions:
    """Options for the simulation in `hil.estimator.simulation.arm`."""

    max_step: float = 0.85e-3
    """Longest integration step [s]."""
    max_substeps: int = 64
    """Maximum number of substeps into which a step is divided near standstill."""


@dataclass(frozen=True)
class MinimiserOptions:
    """Options for Levenberg-Marquardt with coordinates of order 1."""

    max_iterations: int = 150
    max_step: float = 2.0
    """Maximum change in a coordinate per iteration."""
    unfinished: float = 1e-2
    """After `max_iterations`, a relative decrease below this still counts as converged."""
    initial_damping: float = 1e-3
    """Initial damping, as a fraction of the squared norm of the Jacobian's column for each coordinate."""
    min_damping: float = 1e-9
    max_damping: float = 1e3


@dataclass(frozen=True)
class SegmentedMinimiserOptions:
    """Options for Levenberg-Marquardt with additional unknowns per segment."""

    max_iterations: int = 80
    max_step: float = 2.0
    """Maximum change in a coordinate per iteration."""
    unfinished: float = 1e-3
    """After `max_iterations`, a relative decrease below this still counts as converged."""
    initial_damping: float = 1e-3
    min_damping: float = 1e-8
    max_damping: float = 1e5


@dataclass(frozen=True)
class CoordinateOptions:
    """Options for the likelihood's coordinates, which keep parameters in range."""

    width_floor: float
    """Lower bound of the width of every smoothed Coulomb step [rad/s]."""
    widths_per_substep: float = 2.0
    """Largest change in a joint's velocity that a reversal of friction may cause in the shortest substep, in widths of
    the smoothed Coulomb step.

    Beyond about ten, the simulation jumps back and forth across the step: the motion hardly changes, but its
    derivatives grow without bound.
    """
    min_initial: float = 1e-3
    """Minimum initial value of a positive parameter, as a fraction of its scale."""
    max_initial_share: float = 0.95
    """Maximum initial value of a parameter that is bounded by the geometric mean of two others, as a fraction of this
    bound.
    """
    min_width: float = 1e-3
    """Minimum distance between a width and its lower bound, as a fraction of that bound, so that the width can grow
    again.
    """
    max_relative_increase: float = 2.0
    """Maximum relative increase in a width per iteration."""


@dataclass(frozen=True)
class LinearOptions:
    """Options for stage 1, the regression on Fourier coefficients."""

    coulomb_width: float = 0.05
    """Width of the smoothed Coulomb step [rad/s]: roughly the velocity error that omitting Fourier coefficients causes
    while a joint sticks.
    """
    max_condition: float = 1e8


@dataclass(frozen=True)
class CovarianceOptions:
    """Options for the standard errors under correlated residuals."""

    max_lag: int = 400
    """Maximum lag [samples]."""
    max_lag_share: float = 0.05
    """Maximum lag as a fraction of a run's length."""
    min_lag: int = 4
    """Minimum lag [samples]."""
    min_window_share: float = 0.005
    """Minimum window as a fraction of the longest run's length. Rounding errors are slightly correlated even beyond the
    lag at which they appear uncorrelated.
    """


@dataclass(frozen=True)
class LikelihoodOptions:
    """Options for stage 2, maximum likelihood estimation from settled periods.

    Sums of squares are in units of the noise variance: noise alone gives 1 per sample.
    """

    ftol: float = 1e-5
    """Final tolerance: the remaining decrease corresponds to a combined parameter error of 0.1 standard errors."""
    ftol_refine: float = 3e-4
    """Tolerance for comparing candidate minima."""
    ftol_start: float = 3e-3
    """Tolerance of the fit from one initial guess."""
    ftol_coarse: float = 2e-2
    """Tolerance if only the neighbourhood of a minimum is needed: in a coarse fit and in the tracking fit."""
    ftol_state: float = 0.1
    """Tolerance for fitting the initial state alone."""

    coordinates: CoordinateOptions = CoordinateOptions(width_floor=1e-4)
    """A width at its lower bound of 1e-4 rad/s cannot be distinguished from stiction; one of 3e-4 rad/s differs from
    stiction by half a standard error.
    """
    minimiser: MinimiserOptions = MinimiserOptions()
    integration: IntegrationOptions = IntegrationOptions()
    coarse_integration: IntegrationOptions = IntegrationOptions(max_step=2.6e-3, max_substeps=16)
    """Coarse steps, accurate to a few hundredths of an encoder step; they take a third of the time of fine ones."""
    covariance: CovarianceOptions = CovarianceOptions()
    least_inflation: float = 2.0
    """Factor by which the data's variance must exceed that of independent errors before the priors are given more
    weight.
    """
    least_tempering: float = 1e-4
    """Minimum relative increase in the sum of squares for which the fit is repeated with priors that are given more
    weight.
    """

    initial_widths: tuple[float, ...] = (0.005, 0.05)
    """Initial widths of the smoothed Coulomb step [rad/s], all of which are tried."""
    initial_bends: tuple[float, ...] = (1e-3, 5e-3)
    """Initial presliding deflections at which the joint begins to slide [rad], one for each of `initial_widths`."""
    min_initial_lag: float = 1e-4
    """Minimum initial time constant of the current loop [s]."""
    angle_scale: float = 0.1
    """Scale of the initial angles [rad]."""

    tracking_frequency: float = 2.0
    """Natural frequency of the springs that pull each joint towards the measured motion in the tracking fit [Hz].

    An arm that swings past the upright pose amplifies parameter errors, so it is first held to the measured motion.
    """
    tracking_loss: float = 1.5
    """The beginning of a run is fitted first if the cost of the fit without springs exceeds that of the tracking fit by
    this factor.
    """
    horizons: tuple[float, ...] = (0.125, 0.25, 0.5)
    """Initial parts of a run, as fractions of its length, that are fitted in this order before the whole run."""
    min_horizon_samples: int = 10
    """Minimum number of samples per unknown, over all joints; shorter initial parts are skipped."""

    max_relative_decrease: float = 0.8
    """Maximum relative decrease in a Coulomb width per iteration with fine steps, where the cost is nearly quadratic.
    """
    max_relative_decrease_coarse: float = 0.5
    """Maximum relative decrease in a Coulomb width per iteration with coarse steps, far from the minimum."""

    same_motion: float = 0.02
    """Coarse steps remain in use as long as their sum of squares differs from that with fine steps by less than this
    fraction.
    """
    same_cost: float = 1.0
    """Minima whose sums of squares differ by less than this count as the same."""
    close_cost: float = 25.0
    """Minima whose sums of squares differ by less than this are compared again, simulated with fine steps."""
    explained_cost: float = 1.03
    """Cost per sample below which no further initial guess is tried."""
    hopeless_cost: float = 2.0
    """Cost per sample above which a coarse fit is abandoned."""
    refine_ratio: float = 1.01
    """A candidate whose sum of squares is at most this multiple of the best one may still reach a lower sum when
    refined.
    """
    outlier_threshold: float = 4.0
    """Residual in standard deviations above which a sample is downweighted; rounding alone stays below 1.7."""
    threads: int = 8
    """Maximum number of parallel fits; the result does not depend on it."""


@dataclass(frozen=True)
class ShootingOptions:
    """Options for multiple shooting, which fits any recording."""

    ftol: float = 3e-5
    ftol_refine: float = 1e-3
    """Tolerance of the fits after each downweighting of segments."""
    ftol_start: float = 1e-2
    """Tolerance of the fits that only need to come close to a minimum."""
    max_step: float = 1e-3
    """Longest integration step of the last fit [s]."""
    coarse_step: float = 2.6e-3
    """Longest integration step of the earlier fits [s]. They run three times as fast as with `max_step`; their errors
    amount to hundredths of a standard error.
    """
    max_substeps: int = IntegrationOptions.max_substeps
    """Maximum number of substeps into which a step is divided near standstill."""
    start_segments: int = 80
    """Maximum number of segments, evenly distributed, in the fits that only need to come close to a minimum."""
    coordinates: CoordinateOptions = CoordinateOptions(width_floor=3e-4)
    """The lower bound on widths is 3e-4 rad/s. With 3e-3 rad/s, the smoothing of friction affected small motions:
    Coulomb friction was 1 % too large and viscous friction 1 to 3 % too small, by several standard errors.
    """
    minimiser: SegmentedMinimiserOptions = SegmentedMinimiserOptions()
    initial_width: float = 0.05
    """Initial width of the smoothed Coulomb step [rad/s]."""
    initial_bend: float = 0.003
    """Initial presliding deflection at which the joint begins to slide [rad]."""
    initial_stribeck_velocities: tuple[float, ...] = (0.2, 2.0)
    """Initial Stribeck velocities [rad/s], all of which are tried."""
    short: float = 0.25
    """Length of the short segments that are fitted first, as a fraction of the full segment length."""
    angle_scale: float = 0.1
    """Scale of the initial angles [rad]."""
    reweightings: int = 2
    """Number of refits, in which segments are downweighted according to their residual in the previous fit."""


@dataclass(frozen=True)
class CalibrationOptions:
    """Options for the combined likelihood of two periods, one without and one with a known mass."""

    ftol: float = 1e-6
    coordinates: CoordinateOptions = CoordinateOptions(width_floor=3e-4)
    minimiser: MinimiserOptions = MinimiserOptions()
    initial_width: float = 0.005
    """Initial width of the smoothed Coulomb step [rad/s]; a width estimated with wrong torque constants would be
    misleading.
    """
    angle_scale: float = 0.1
    """Scale of the initial angles [rad]."""
    difference: float = 1e-6
    """Step of the finite differences, in units of the coordinates."""


@dataclass(frozen=True)
class SettlingOptions:
    """Options for a simulation that continues until the motion is periodic."""

    max_periods: int = 50
    atol: float = 1e-7
    """The motion counts as periodic if a period changes the state by no more than this [rad and rad/s]."""
    acceptable: float = 1e-5
    """Change per period that is still accepted after `max_periods` [rad and rad/s]; far below any encoder step."""


@dataclass(frozen=True)
class SelectionOptions:
    """Options for selecting a friction model by held-out error."""

    keep_ratio: float = 0.98
    """A richer model is kept only if its error is below this fraction of the error of the best model so far."""
    explained_residual: float = 1.02
    """RMS residual, in units of the noise, below which no further term is tried."""
    near_residual: float = 5.0
    """RMS residual, in units of the noise, below which a richer model's fit starts at the simpler model's minimum."""
    steady_residual: float = 5.0
    """RMS residual, in units of the noise, below which changes in friction are searched for; a larger model error may
    look like such a change.
    """
    presliding_residual: float = 1.2
    """RMS residual in units of the noise above which a fit with presliding is tried; such fits are slow."""
    initial_widths: tuple[float, ...] = (5e-4, 2e-2)
    """Initial widths of one joint's smoothed Coulomb step [rad/s], tried if the motion is not explained."""
    initial_bends: tuple[float, ...] = (1e-3, 5e-3)
    """Initial presliding deflections at which one joint begins to slide [rad], tried if the motion is not explained."""
    max_restarts: int = 6
    """Maximum number of fits from other initial guesses."""
    overrule_ratio: float = 0.8
    """Another model replaces the chosen one only if its prediction error is below this fraction of the chosen
    model's.
    """
    wave_cycles: tuple[float, ...] = tuple(0.5 * n for n in range(6, 33)) + tuple(float(n) for n in range(17, 41))
    """Numbers of ripple and cogging cycles per turn to try."""
    max_wave_peaks: int = 3
    """Maximum number of spatial frequencies (cycles per turn) from which fits with ripple or cogging start."""
    wave_evidence: float = 0.05
    """Minimum evidence in the score test for ripple or cogging to be tried. It is low because the test finds the wave's
    period only roughly.
    """
    prune_levels: tuple[float, ...] = (1e-3, 0.1)
    """Significance levels for removing terms, tried in turn until the reduced model explains the motion equally well.
    """
