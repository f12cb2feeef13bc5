"""`hil schema`: print the JSON Schema of the TOML file, for editors."""

from pathlib import Path
from typing import Annotated

import typer


def schema(
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write to this file instead of standard output.")
    ] = None,
) -> None:
    """Print the JSON Schema of the TOML file. Editors use it to complete and check a file that begins with `#:schema
    FILE`.
    """
    from hil.config.json_schema import schema_text
    from hil.whole_file import write_whole

    if out is None:
        print(schema_text(), end="")
        return
    write_whole(out, schema_text())
    print(f"Wrote {out}. Make this the first line of a TOML file in the same folder: #:schema ./{out.name}")
