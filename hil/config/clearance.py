"""`[clearance]`: what a spatial arm must not touch, and the required distance."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from hil.config.table import Table

Point = Annotated[list[float], Field(min_length=3, max_length=3)]


class BoxConfig(Table):
    """`[[clearance.boxes]]`: something in the way. Seen from the base's origin with z upwards."""

    name: str = Field(min_length=1, max_length=40)
    centre: Point = Field(description="m")
    size: Annotated[list[PositiveFloat], Field(min_length=3, max_length=3)] = Field(description="m along its edges")
    turned: Point = Field([0.0, 0.0, 0.0], description="roll, pitch and yaw, rad")


class ClearanceConfig(Table):
    """`[clearance]`: how near a spatial arm may come to itself, the floor and boxes."""

    margin: float = Field(0.01, ge=0, le=0.5, description="m that must stay free along the whole planned motion")
    floor: float | Literal["none"] = Field(
        0.0, description='height of the table or floor above the base\'s origin, m; "none" where there is none in reach'
    )
    boxes: list[BoxConfig] = Field([], description="what else is in the way")
    ignore: list[Annotated[list[str], Field(min_length=2, max_length=2)]] = Field(
        [], description='pairs of links (or "floor", or a box) that need no clearance'
    )
