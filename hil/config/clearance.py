"""`[clearance]`: what a spatial arm must not touch, and the required distance."""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from hil.config.table import Table, Turned
from hil.toml_errors import UNSAID

Point = Annotated[list[Annotated[float, Field(ge=-10, le=10)]], Field(min_length=3, max_length=3)]

_Floor = Annotated[
    Annotated[float, Field(ge=-5, le=5), Tag(f"{UNSAID}height")] | Annotated[Literal["none"], Tag(f"{UNSAID}none")],
    Discriminator(lambda value: f"{UNSAID}none" if isinstance(value, str) else f"{UNSAID}height"),
]


class BoxConfig(Table):
    """`[[clearance.boxes]]`: an obstacle. Coordinates are relative to the base's origin, with z pointing upwards."""

    name: str = Field(min_length=1, max_length=40)
    centre: Point = Field(description="m")
    size: Annotated[list[Annotated[float, Field(gt=0, le=20)]], Field(min_length=3, max_length=3)] = Field(
        description="m, lengths of its edges"
    )
    turned: Annotated[list[Turned], Field(min_length=3, max_length=3)] = Field(
        [0.0, 0.0, 0.0], description="roll, pitch and yaw, rad"
    )


class ClearanceConfig(Table):
    """`[clearance]`: how close a spatial arm may come to itself, the floor and boxes."""

    margin: float = Field(0.01, ge=0, le=0.5, description="m, minimum clearance along the whole planned motion")
    floor: _Floor = Field(
        0.0, description='height of the table or floor above the base\'s origin, m; "none" if neither is within reach'
    )
    boxes: list[BoxConfig] = Field([], description="other obstacles")
    ignore: list[Annotated[list[str], Field(min_length=2, max_length=2)]] = Field(
        [], description='pairs that need no clearance: moving links, the base, boxes or "floor"'
    )
