"""A table of named numeric columns, independent of the file format."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from hil.errors import CsvError
from hil.recordings.units import split_head

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Table:
    """One recording as stored in a file.

    columns: values (rows,) by name, NaN where a value is missing and infinite where it is not a number. units: units
    stated in the file, by column. first_row: number of the first row, for messages (a CSV file's header is line 1).
    texts: first non-numeric entry of each column that has one, as written in the file.
    """

    source: str
    columns: Mapping[str, Values]
    units: Mapping[str, str] = field(default_factory=dict)
    first_row: int = 1
    row_word: str = "row"
    texts: Mapping[str, str] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def find(self, name: str) -> tuple[str, Values, str | None]:
        """Find the column `name`; return its full name, values, and the unit stated in the file, as written.

        `name` may omit the unit and is not case-sensitive. Raises CsvError.
        """
        full = self._full_name(name)
        values = self.columns[full]
        bad = np.nonzero(np.isinf(values))[0]
        if bad.size:
            text = self.texts.get(full, str(values[bad[0]]))
            dates = " Dates and times are read in the form 2026-03-01T12:00:00.008 (ISO 8601)."
            raise CsvError(
                f"{self.source}, {self.row_word} {bad[0] + self.first_row}: column {full!r} is {text!r}; it must be a "
                f"finite number{'; this is too large' if re.fullmatch('[-+.0-9]+e[+]?[0-9]+', text.lower()) else ''}."
                f"{dates if re.search('[0-9][-:/.][0-9]', text) else ''}"
            )
        return full, values, self.units.get(full) or split_head(full)[1]

    def _full_name(self, name: str) -> str:
        if name in self.columns:
            return name
        bare = {split_head(each)[0]: each for each in self.columns}
        if name in bare:
            return bare[name]
        folded = [each for each in (*self.columns, *bare) if each.casefold() == name.casefold()]
        if folded:
            return bare.get(folded[0], folded[0])
        near = get_close_matches(name, [*self.columns, *bare], 1)
        meant = f" Did you mean {near[0]!r}?" if near else ""
        raise CsvError(
            f"{self.source} has no column {name!r}; it has {self.listed()}.{meant} Set [columns] in the TOML file."
        )

    def listed(self) -> str:
        """Column names for a message; only the first ones if there are many."""
        names = list(self.columns)
        more = f" and {len(names) - 40} more" if len(names) > 40 else ""
        return ", ".join(names[:40]) + more
