"""The estimator's exceptions, all of them subclasses of EstimationError."""

__all__ = [
    "ConvergenceError",
    "EstimationError",
    "ExcitationError",
    "ModelError",
    "PeriodicityError",
    "RecordingError",
    "ShapeError",
    "StandstillError",
    "UnidentifiableError",
]


class EstimationError(Exception):
    """Base class of all errors that the estimator raises."""


class ExcitationError(EstimationError):
    """A multisine or path cannot be built, for example because its band is empty or no path satisfies the limits."""


class RecordingError(EstimationError):
    """The samples cannot be used: too many are missing, values are not finite, or a period does not close."""


class ShapeError(RecordingError):
    """Arrays with incompatible shapes; the message quotes both shapes."""


class StandstillError(RecordingError):
    """A joint moved by at most a few encoder steps, so its parameters cannot be identified."""


class ModelError(EstimationError):
    """A friction model, drive model or number of joints that the estimator does not support."""


class UnidentifiableError(EstimationError):
    """The regression is singular: the motion does not separate some parameters."""


class ConvergenceError(EstimationError):
    """The fit found no minimum: the model or the initial guess is too far from the data."""


class PeriodicityError(EstimationError):
    """The simulated arm does not settle into periodic motion."""
