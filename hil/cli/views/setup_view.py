"""Output of scan, check and setup: tables for the terminal and plain values for JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.setup.preflight import Finding, Level
from hil.setup.scan import Heard
from hil.setup.servo_settings import Change

_STYLES = {Level.OK: "green", Level.WARNING: "yellow", Level.STOP: "red"}


def print_ports(ports: Sequence[tuple[str, str]], json_only: bool) -> None:
    """Print the machine's serial ports and the next command to type."""
    if json_only:
        print(json.dumps({"ports": [{"device": device, "description": text} for device, text in ports]}))
        return
    if not ports:
        print("No serial port found. To use a TOML file: hil scan configs/fake_two_link.toml")
        return
    for device, text in ports:
        print(f"{device}  {text}")
    print(f"\nNext: hil scan {ports[0][0]}")


def scanned(heard: Sequence[Heard]) -> dict[str, Any]:
    """A scan as plain values for JSON."""
    return {
        "servos": [servo._asdict() for each in heard for servo in each.servos],
        "trouble": [{"baud": each.baud, "trouble": each.trouble} for each in heard if each.trouble],
    }


def print_scan(heard: Sequence[Heard], port: str) -> None:
    console = Console(highlight=False)
    table = Table(title=f"Servos on {escape(port)}", title_justify="left")
    for heading in ("baud", "ID", "model", "firmware", "supply V", "C", "trouble"):
        table.add_column(heading)
    for each in heard:
        for servo in each.servos:
            model = servo.model or f"model number {servo.model_number}"
            voltage = "" if servo.voltage is None else f"{servo.voltage:.1f}"
            heat = "" if servo.temperature is None else f"{servo.temperature:.0f}"
            cells = (str(each.baud), str(servo.id), model, str(servo.firmware), voltage, heat, escape(servo.trouble))
            table.add_row(*cells)
    servos = [servo for each in heard for servo in each.servos]
    if servos:
        console.print(table)
    else:
        console.print("No servo answered. Is the bus powered? A U2D2 does not supply power.")
    for each in heard:
        if each.trouble:
            console.print(f"At {each.baud} baud: {escape(each.trouble)}")
    if len({servo.baud for servo in servos}) > 1:
        console.print("All servos of an arm must use the same baud rate: see hil setup --help.")


def print_findings(findings: Sequence[Finding], config: Path) -> None:
    """Print one line per finding, with its fix below it, and whether an experiment can start."""
    console = Console(highlight=False, soft_wrap=True)
    former = None
    for finding in findings:
        if finding.where != former:
            console.print(f"[bold]{escape(finding.where)}[/bold]")
            former = finding.where
        style = _STYLES[finding.level]
        level = f"[{style}]{finding.level:>8}[/{style}]"
        console.print(f"{level}  {escape(finding.what)}: {escape(finding.found)}")
        if finding.fix:
            console.print(f"          {escape(finding.fix)}")
    stops = sum(finding.level is Level.STOP for finding in findings)
    warnings = sum(finding.level is Level.WARNING for finding in findings)
    if stops:
        console.print(f"\n{stops} blocking problems, {warnings} warnings.")
    else:
        console.print(f"\nReady, {warnings} warnings. Next: hil identify {escape(str(config))}")


def changed(changes: Sequence[Change]) -> dict[str, Any]:
    """The changes made by setup as plain values for JSON."""
    return {"changes": [change._asdict() for change in changes]}


def print_changes(changes: Sequence[Change]) -> None:
    if not changes:
        print("Nothing to change: give --new-id, --new-baud, --return-delay-us or --secondary-id.")
    for change in changes:
        if change.written:
            print(f"{change.register}: {change.before} -> {change.after}, read back.")
        elif change.before == change.after:
            print(f"{change.register}: is already {change.after}.")
        else:
            print(f"{change.register}: left at {change.before}.")
