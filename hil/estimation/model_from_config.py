"""From `[model]` to the model that the estimator fits."""

from hil.config.experiment import ModelConfig
from hil.estimator.models.model import Model
from hil.estimator.models.terms import OPTIONS


def wanted_model(wanted: ModelConfig, joints: int) -> Model:
    """What the file asks for, of an arm of `joints`; where it says "auto", Stribeck friction."""
    return Model(
        joints,
        wanted.fixed_friction,
        wanted.drive,
        {option for option in OPTIONS if getattr(wanted, option)},
    )
