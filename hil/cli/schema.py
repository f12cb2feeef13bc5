"""`hil schema`: the JSON Schema of the TOML, for editors."""

from pathlib import Path
from typing import Annotated

import typer


def schema(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write it to this file instead of standard output.")
    ] = None,
) -> None:
    """Print the JSON Schema of the TOML; with `#:schema FILE` as its first line an editor completes and checks it."""
    from hil.config.json_schema import schema_text
    from hil.export.source import write_text

    if out is None:
        print(schema_text(), end="")
        return
    write_text(out, schema_text())
    print(f"Wrote {out}. Put this first in a TOML file beside it: #:schema ./{out.name}")
