"""Output of scan, check and setup: tables for the terminal and plain values for JSON."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hil.config.schema import config_of
from hil.drivers.torque.off import and_list
from hil.next_step import NEXT, next_step
from hil.printing import print_fitting, result_console, say, say_behind
from hil.setup.finding import Finding, Level
from hil.setup.scan import TORQUE_ON, Found, Heard
from hil.setup.servo_settings import Change

_MOST_PLANAR_JOINTS = 2

_STYLES = {Level.OK: "green", Level.WARNING: "yellow", Level.STOP: "red"}


def print_ports(ports: Sequence[tuple[str, str]], json_only: bool) -> None:
    if json_only:
        print(json.dumps({"ports": [{"device": device, "description": text} for device, text in ports]}))
        return
    if not ports:
        print("No serial port found. To use a TOML file: hil scan configs/fake_two_link.toml")
        return
    for device, text in ports:
        print(f"{device}  {text}")
    print(f"\n{next_step('scan', ports[0][0])}")


def scanned(heard: Sequence[Heard]) -> dict[str, Any]:
    return {
        "servos": [servo._asdict() for each in heard for servo in each.servos],
        "trouble": [{"baud": each.baud, "trouble": each.trouble} for each in heard if each.trouble],
    }


def print_scan(heard: Sequence[Heard], port: str) -> None:
    console = result_console()
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
        print_fitting(console, table)
    else:
        console.print("No servo answered. Is the bus powered? A U2D2 does not supply power.")
    for each in heard:
        if each.trouble:
            console.print(f"At {each.baud} baud: {escape(each.trouble)}")
    for servo in servos:
        if servo.left:
            say(console, f"ID {servo.id}: {servo.left}")
    if len({servo.baud for servo in servos}) > 1:
        console.print("All servos of an arm must use the same baud rate: see hil setup --help.")
    if on := [str(servo.id) for servo in servos if TORQUE_ON in servo.trouble and not servo.left]:
        say(
            console,
            f"Torque is on at ID {and_list(on)}: another program drives the servo, or has left it like this. Stop that "
            "program; if there is none, hold the arm and power-cycle the servo before you type the next command.",
        )
    if servos:
        _print_next(console, servos, port)


def _print_next(console: Console, servos: Sequence[Found], port: str) -> None:
    after = _after_scan(servos, port)
    if after == _describing(port) and len(servos) > _MOST_PLANAR_JOINTS:
        say(
            console,
            f"`hil init` describes arms of one or two joints. If these {len(servos)} servos belong to one arm, write "
            "its file as docs/estimating.md explains (Spatial arms), then type: hil check my_arm.toml",
        )
    print(after)


def _after_scan(servos: Sequence[Found], port: str) -> str:
    """Return the next command: restore what a killed run left, set all servos to one baud rate, or describe or check
    the arm.
    """
    if restore := next((servo.restore for servo in servos if servo.restore), ""):
        return f"{NEXT}{restore}"
    if config_of(port):
        return next_step("check", port)
    if len({servo.baud for servo in servos}) > 1:
        other = min(servos, key=lambda servo: servo.baud)
        common = max(servo.baud for servo in servos)
        return next_step("setup", port, "--baud", other.baud, "--id", other.id, "--new-baud", common)
    return _describing(port)


def _describing(port: str) -> str:
    return next_step("init", port, "--out", "my_arm.toml")


def print_findings(findings: Sequence[Finding], config: Path, *, has_dry_run: bool) -> None:
    """Print one line per finding, with its fix on the line below, and say whether an experiment can start.

    has_dry_run: whether the arm is described well enough for `hil dry-run`, which is then the next command.
    """
    console = result_console()
    former = None
    for finding in findings:
        if finding.where != former:
            console.print(f"[bold]{escape(finding.where)}[/bold]", soft_wrap=True)
            former = finding.where
        style = _STYLES[finding.level]
        say_behind(console, f"{finding.level:>8}  ", f"{finding.what}: {finding.found}", style)
        if finding.fix:
            say_behind(console, 10 * " ", finding.fix)
    stops = sum(finding.level is Level.STOP for finding in findings)
    warnings = sum(finding.level is Level.WARNING for finding in findings)
    if stops:
        say(console, f"\n{_counted(stops, 'blocking problem')}, {_counted(warnings, 'warning')}. Fix them.")
    else:
        say(console, f"\nReady, {_counted(warnings, 'warning')}.")
    if step := next((finding.step for finding in findings if finding.step), ""):
        print(f"{NEXT}{step}")
        return
    print(next_step("check" if stops else "dry-run" if has_dry_run else "identify", config))


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def changed(changes: Sequence[Change]) -> dict[str, Any]:
    return {"changes": [change._asdict() for change in changes]}


def print_changes(changes: Sequence[Change], port: str) -> None:
    if not changes:
        print("Nothing to change: give --new-id, --new-baud, --return-delay-us or --secondary-id.")
    for change in changes:
        before, after = (f"{value} {change.unit}".rstrip() for value in (change.before, change.after))
        if change.written:
            print(f"{change.register}: {before} -> {after}, read back.")
        elif before == after:
            print(f"{change.register} is already {after}.")
        else:
            print(f"{change.register}: left at {before}.")
    print(next_step("scan", port))
