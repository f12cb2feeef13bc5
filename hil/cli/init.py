"""`hil init`: create a TOML file for the servos found on a bus."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from hil.cli.options import PortOrFile


def init(
    port: PortOrFile,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file to write.")] = Path("my_arm.toml"),
    baud: Annotated[
        list[int] | None, typer.Option("--baud", help="Scan only at this baud rate; may be repeated.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Ask no questions; accept every default.")] = False,
) -> None:
    """Scan the bus, ask about the arm, and write a commented TOML file. Torque stays off; no setting is changed."""
    from hil.cli.terminal import Terminal
    from hil.cli.views.question import answer
    from hil.config.fake_url import url_for
    from hil.config.schema import parse_config, port_url
    from hil.drivers.port import open_port
    from hil.drivers.servo_model import BAUD_RATES
    from hil.errors import ConfigError
    from hil.next_step import next_step
    from hil.setup.config_template import arm_toml
    from hil.setup.interview import interview
    from hil.setup.measured_bus import measured_bus
    from hil.setup.session.leftovers import scan_with_leftovers
    from hil.whole_file import write_whole

    url = port_url(port)
    bauds = tuple(baud or BAUD_RATES)
    terminal = Terminal(quiet=False)
    opened = open_port(url, bauds[0])
    try:
        if out.exists():
            raise ConfigError(f"{out} already exists: choose another file with --out, or remove it.")
        if not out.absolute().parent.is_dir():
            raise ConfigError(f"--out {out}: the folder {out.parent} does not exist. Create it first.")
        with terminal.scanning() as watch:
            heard = list(scan_with_leftovers(opened, bauds, watch))
        answers = interview(opened, url_for(url, out), heard, _default if yes else answer, _say)
    finally:
        opened.close()
    parse_config(arm_toml(answers), out)  # raises if the file would not be valid
    with terminal.busy("Measuring the rate that the bus can sustain"):
        found, said = measured_bus(answers, out)
    terminal.say(said)
    text = arm_toml(replace(answers, measured=found))
    parse_config(text, out)
    write_whole(out, text)
    print(f"Wrote {out}. Read it, then type the next command.\n{next_step('check', out)}")


def _default(_question: str, usual: str) -> str:
    return usual


def _say(text: str) -> None:
    typer.echo(text, err=True)
