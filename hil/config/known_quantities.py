"""`[known]` in the TOML file: lengths, masses and rotor inertias measured by the user."""

from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator

from hil.estimator.models.physical_parameters import Known


class Measured(BaseModel):
    """A value with its standard error."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    value: float
    std: float = Field(0.0, ge=0)


Quantity = Annotated[float | Measured | None, Field(description="a number in SI units, or {value = .., std = ..}")]


class KnownConfig(BaseModel):
    """`[known]`: values from a ruler, scales or a data sheet. Each entry is a number or {value = .., std = ..}."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    length_1: Quantity = None
    mass_1: Quantity = None
    centre_1: Quantity = None
    link_inertia_1: Quantity = None
    armature_1: Quantity = None
    mass_elbow: Quantity = None
    mass_2: Quantity = None
    centre_2: Quantity = None
    link_inertia_2: Quantity = None
    armature_2: Quantity = None
    rotor_inertia_1: Quantity = None
    rotor_inertia_2: Quantity = None
    gear_ratio_1: PositiveFloat | None = None
    gear_ratio_2: PositiveFloat | None = None

    @model_validator(mode="after")
    def _rotors_have_gears(self) -> Self:
        for joint in ("1", "2"):
            rotor, gear = getattr(self, f"rotor_inertia_{joint}"), getattr(self, f"gear_ratio_{joint}")
            if (rotor is None) != (gear is None):
                raise ValueError(f"known: rotor_inertia_{joint} and gear_ratio_{joint} belong together; give both")
            if rotor is not None and getattr(self, f"armature_{joint}") is not None:
                raise ValueError(
                    f"known: armature_{joint} and rotor_inertia_{joint} mean the same thing; give only one"
                )
        return self

    def quantities(self) -> dict[str, Known]:
        """The known quantities, keyed by the names in hil.estimator.models.physical_parameters.

        Rotor inertia times gear ratio squared is returned as armature.
        """
        found: dict[str, Known] = {}
        for name in type(self).model_fields:
            item = getattr(self, name)
            if item is None or name.startswith("gear_ratio"):
                continue
            known = Known(item.value, item.std) if isinstance(item, Measured) else Known(float(item))
            if name.startswith("rotor_inertia"):
                joint = name[-1]
                squared = getattr(self, f"gear_ratio_{joint}") ** 2
                name = f"armature_{joint}"  # noqa: PLW2901 - the same quantity on the joint's side
                known = Known(known.value * squared, known.std * squared)
            found[name] = known
        return found
