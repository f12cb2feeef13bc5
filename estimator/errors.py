"""What can go wrong in the estimator, as a tree.

EstimationError
├── ExcitationError       the requested multisine cannot be built
├── RecordingError        the samples are not a settled period of an experiment
│   ├── ShapeError        arrays whose sizes do not fit together
│   └── StandstillError   a joint never moved
├── ModelError            no such friction or drive model, or no such number of joints
├── UnidentifiableError   the data do not separate some parameters
├── ConvergenceError      the likelihood found no minimum
└── PeriodicityError      the simulated arm does not settle into periodic motion
"""


class EstimationError(Exception):
    """The root: catch this to catch all that the estimator raises."""


class ExcitationError(EstimationError):
    """A multisine cannot be built: an empty band, a line above half the rate, a peak that is not positive."""


class RecordingError(EstimationError):
    """No settled period: too many samples are missing, values are not finite, the period does not close."""


class ShapeError(RecordingError):
    """Arrays whose sizes do not fit together; the message quotes both."""


class StandstillError(RecordingError):
    """A joint moved by a few encoder steps at most: nothing to identify there."""


class ModelError(EstimationError):
    """A friction model, drive model or number of joints that the estimator does not have."""


class UnidentifiableError(EstimationError):
    """The regression is singular: the motion does not separate some parameters."""


class ConvergenceError(EstimationError):
    """The likelihood's iterations ended without a minimum: the model or the initial guess is far from the data."""


class PeriodicityError(EstimationError):
    """The simulated arm does not settle into periodic motion under this multisine."""
