"""Arguments and options that several subcommands share."""

from pathlib import Path
from typing import Annotated

import typer

ConfigPath = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="TOML file of the arm, or the name of a bundled one.")
]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder of `hil identify` or `hil record`.")]
OutPath = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Run folder; default: runs/TIME-ARM.")]
PortOrFile = Annotated[
    str, typer.Argument(metavar="PORT", help="Serial port or pyserial URL, a TOML file, or a bundled name.")
]
Json = Annotated[bool, typer.Option("--json", help="Print only the result, as one JSON object.")]
