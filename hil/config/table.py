"""The base class and field types shared by all tables of the TOML file."""

from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag

from hil.fakes.plants.arm import PI
from hil.toml_errors import UNSAID


class Table(BaseModel):
    """Base class of all tables, which are frozen and reject unknown keys, wrong types, infinity and NaN."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must not contain line breaks, tabs or other unprintable characters")
    return text


Printable = Annotated[str, AfterValidator(_printable)]
"""Text without control characters, line breaks or surrogates, because it appears in terminals, XML, HTML and CSV."""

BusId = Annotated[int, Field(ge=0, le=252)]
_One = TypeVar("_One")
OneOrList = Annotated[
    Annotated[_One, Tag(f"{UNSAID}one")] | Annotated[list[_One], Tag(f"{UNSAID}list")],
    Discriminator(lambda value: f"{UNSAID}list" if isinstance(value, list) else f"{UNSAID}one"),
]
"""A single value or a list; validation errors refer to the form that was given."""
Angle = Annotated[float, Field(ge=-4 * PI, le=4 * PI)]
"""An angle of a joint [rad]: up to two turns, so that values in degrees are detected."""

Turned = Annotated[float, Field(ge=-2 * PI, le=2 * PI)]
"""A mounting angle [rad], such as that of the base or of an obstacle."""

Range = Annotated[list[float], Field(min_length=2, max_length=2)]
