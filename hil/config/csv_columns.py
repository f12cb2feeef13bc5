"""The columns of a recording made elsewhere, and their units: `[columns]` in the TOML file.

[columns]
time = "time"                                     # in seconds unless time_unit is given
position = ["pos_meas1", "pos_meas2"]             # one per joint
torque = ["tau_meas1", "tau_meas2"]               # or current, which needs torque_constant
position_unit = "rad"                             # rad, deg, turns
zero = [-1.5707963, 0.0]                          # rad added to the column: joint 1 is measured from the horizontal
"""

import re
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, field_validator, model_validator

from hil.config.table import Angle, Table

Gain = Annotated[float, Field(gt=0, le=100)]
Column = Annotated[str, Field(min_length=1)]
TICKS = "ticks"
PLANAR = 2
POSITION_UNITS = {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295, "turns": 6.283185307179586, TICKS: 1.0}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TORQUE_UNITS = {
    "N m": 1.0,
    "mN m": 1e-3,
    "N cm": 1e-2,
    "kgf cm": 0.0980665,
    "ozf in": 7.0615518e-3,
    "lbf in": 0.11298483,
}
CURRENT_UNITS = {"A": 1.0, "mA": 1e-3}
VOLTAGE_UNITS = {"V": 1.0, "mV": 1e-3}
PWM_UNITS = {"1": 1.0, "%": 1e-2}


class Columns(Table):
    """`[columns]`: the meaning and unit of each column. Whatever is omitted is taken from the column headers."""

    time: Column | None = None
    rate: PositiveFloat | None = Field(None, le=1e5, description="samples per second, if there is no time column")
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    position: list[Column] | None = Field(
        None, min_length=1, max_length=7, description="one column per joint, from the base outwards"
    )
    position_unit: Literal["rad", "mrad", "deg", "turns", "ticks"] | None = None
    angles: Literal["relative", "absolute"] = Field(
        "relative", description="absolute: every angle is measured from the same direction, not from the previous link"
    )
    ticks_per_turn: PositiveFloat | None = Field(
        None, description="encoder ticks in one turn of the joint, for positions in ticks"
    )
    zero: list[Angle] | None = Field(
        None, description="rad, added to each position, so that joint 1 is measured from the horizontal"
    )
    position_step: PositiveFloat | None = Field(
        None, le=0.05, description="rad per encoder step; detected from the data if absent"
    )
    torque: list[Column] | None = Field(None, description="one column per joint")
    torque_unit: Literal["N m", "mN m", "N cm", "kgf cm", "ozf in", "lbf in"] | None = None
    current: list[Column] | None = Field(None, description="one column per joint, in place of torque")
    current_unit: Literal["A", "mA"] | None = None
    torque_constant: list[Gain] | None = Field(
        None, description="N m/A per joint at the output shaft; needed with current, or with voltage and resistance"
    )
    voltage: list[Column] | None = Field(None, description="motor voltage, one column per joint, in place of torque")
    voltage_unit: Literal["V", "mV"] | None = None
    pwm: list[Column] | None = Field(None, description="fraction of the supply voltage, one column per joint")
    pwm_unit: Literal["1", "%"] | None = None
    supply_voltage: PositiveFloat | None = Field(None, le=1000, description="V, with pwm")
    resistance: list[Annotated[float, Field(gt=0, le=1000)]] | None = Field(
        None, description="resistance of the motor windings, ohm per joint"
    )
    torque_per_volt: list[Gain] | None = Field(
        None, description="N m/V per joint at standstill: stall torque over voltage, or torque_constant / resistance"
    )
    between: Literal["held", "linear"] = Field(
        "linear", description="torque between samples: held for commands, linear for measurements"
    )
    segment: PositiveFloat = Field(
        1.0, le=60, description="s, duration of each shooting segment; its initial state is estimated"
    )
    zeros_unknown: bool = Field(True, description="estimate each encoder's zero offset")

    @field_validator("torque_unit", mode="before")
    @classmethod
    def _with_space(cls, unit: object) -> object:
        """Accept "mNm" for "mN m"."""
        joined = {name.replace(" ", ""): name for name in TORQUE_UNITS}
        return joined.get(re.sub(r"[ *·.]", "", unit), unit) if isinstance(unit, str) else unit

    @property
    def drive(self) -> Literal["torque", "current", "voltage", "pwm"] | None:
        """Kind of column that describes how the joints were driven; None if there are no such columns."""
        kinds: tuple[Literal["torque", "current", "voltage", "pwm"], ...] = ("torque", "current", "voltage", "pwm")
        return next((kind for kind in kinds if getattr(self, kind) is not None), None)

    @property
    def gains(self) -> list[float] | None:
        """Torque per ampere or per volt of each joint [N m/A or N m/V]; None if the columns hold torques."""
        if self.drive in {"voltage", "pwm"}:
            if self.torque_per_volt is not None:
                return list(self.torque_per_volt)
            assert self.torque_constant is not None and self.resistance is not None  # checked
            return [gain / ohm for gain, ohm in zip(self.torque_constant, self.resistance, strict=True)]
        return None if self.torque_constant is None or self.drive != "current" else list(self.torque_constant)

    def without_effect(self, *, in_ticks: bool) -> tuple[str, ...]:
        """Return those keys of the table that have no effect with these columns. in_ticks: whether positions are in
        ticks.
        """
        by_voltage = self.drive in {"voltage", "pwm"}
        applies = {
            "time_unit": self.time is not None,
            "ticks_per_turn": in_ticks,
            **{f"{kind}_unit": self.drive == kind for kind in ("torque", "current", "voltage", "pwm")},
            "torque_constant": by_voltage or self.drive == "current",
            "supply_voltage": self.drive == "pwm",
            "resistance": by_voltage and self.torque_per_volt is None,
            "torque_per_volt": by_voltage,
        }
        return tuple(key for key, used in applies.items() if not used and getattr(self, key) is not None)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        drives = [kind for kind in ("torque", "current", "voltage", "pwm") if getattr(self, kind) is not None]
        if len(drives) > 1:
            raise ValueError(f"columns.{' and columns.'.join(drives)} are both given; give only one of them")
        if self.time is not None and self.rate is not None:
            raise ValueError("columns.time and columns.rate are both given; give only one of them")
        if self.current is not None and self.torque_constant is None:
            raise ValueError(
                "columns.torque_constant is missing: columns.current requires it (in N m/A, one value per joint)"
            )
        if drives in (["voltage"], ["pwm"]):
            if self.torque_per_volt is None and (self.torque_constant is None or self.resistance is None):
                raise ValueError(
                    f"columns.torque_per_volt is missing: {drives[0]} needs it [N m/V per joint], or torque_constant "
                    "and resistance"
                )
            if self.pwm is not None and self.supply_voltage is None:
                raise ValueError("columns.supply_voltage [V] is missing: pwm is a fraction of it")
        if self.position_unit == TICKS and self.ticks_per_turn is None:
            raise ValueError("columns.ticks_per_turn is missing: positions are in ticks (4096 for X-series servos)")
        self._one_each()
        self._one_role_each()
        return self

    def _one_role_each(self) -> None:
        """Refuse a column that is named twice, since its values cannot represent two quantities."""
        roles = [("columns.time", [self.time] if self.time else []), ("columns.position", self.position or [])]
        if self.drive is not None:
            roles.append((f"columns.{self.drive}", getattr(self, self.drive)))
        seen: dict[str, str] = {}
        for key, names in roles:
            for name in names:
                if seen.get(name) == key:
                    raise ValueError(f'{key} names "{name}" twice; each joint needs a column of its own')
                if name in seen:
                    raise ValueError(f'{seen[name]} and {key} both name "{name}"; a column holds only one quantity')
                seen[name] = key

    def _one_each(self) -> None:
        per_joint = ("torque", "current", "voltage", "pwm", "torque_constant", "resistance", "torque_per_volt", "zero")
        given = {key: len(values) for key in per_joint if (values := getattr(self, key)) is not None}
        count = len(self.position) if self.position is not None else None
        for key, size in given.items():
            if count is not None and size != count:
                entries = "1 entry" if size == 1 else f"{size} entries"
                raise ValueError(f"columns.{key} has {entries}; position has {count}, one per joint")
