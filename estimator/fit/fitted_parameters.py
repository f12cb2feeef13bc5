"""Common interface of all fitted models: parameters by name, standard errors and the residual in encoder steps."""

from dataclasses import dataclass

import numpy as np

from hil.estimator.arrays import Array

__all__ = ["FittedParameters"]


@dataclass(frozen=True)
class FittedParameters:
    """Parameters fitted to measured positions, with their covariance and the residual of the fit."""

    names: tuple[str, ...]
    """Parameter names: base parameters, then friction terms, then drive terms."""
    units: tuple[str, ...]
    """SI unit of each parameter."""
    value: Array
    """Parameter values (parameters,) [SI]."""
    covariance: Array
    """Covariance of `value` (parameters, parameters) [SI]."""
    residual: Array
    """Measured minus simulated position (joints, samples) [rad]; NaN where a sample is missing."""
    position_step: Array
    """Encoder step of each joint (joints,) [rad]."""

    @property
    def std(self) -> Array:
        """Standard errors (parameters,) [SI]."""
        std: Array = np.sqrt(np.diag(self.covariance))
        return std

    @property
    def residual_steps(self) -> Array:
        """RMS residual of each joint in encoder steps (joints,); rounding alone leaves 0.2887."""
        rms: Array = np.sqrt(np.nanmean(self.residual**2, axis=1)) / self.position_step
        return rms

    @property
    def parameters(self) -> dict[str, float]:
        """Parameter values by name [SI]."""
        return dict(zip(self.names, self.value.tolist(), strict=True))
