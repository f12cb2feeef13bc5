"""Conversion of `[model]` to the model that the estimator fits."""

from hil.config.experiment import ModelConfig
from hil.estimator.models.model import Model
from hil.estimator.models.terms import OPTIONS


def wanted_model(wanted: ModelConfig, joints: int) -> Model:
    """The model requested by the file for an arm with `joints` joints; "auto" gives Stribeck friction."""
    return Model(
        joints,
        wanted.fixed_friction,
        wanted.drive,
        {option for option in OPTIONS if getattr(wanted, option)},
    )
