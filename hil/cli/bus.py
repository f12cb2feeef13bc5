"""The subcommands that work on the servos of a bus: scan, check, pose, setup.

The modules that do the work are imported inside the commands, as in hil.cli.app.
"""

import json
import sys
from collections.abc import Callable
from typing import Annotated

import typer

from hil.cli.options import ConfigPath, Json, PortOrFile

PortOrConfig = Annotated[
    str | None,
    typer.Argument(
        metavar="[PORT]",
        help="Serial port or pyserial URL, a TOML file, or a bundled name; if omitted, list the ports.",
    ),
]


def scan(
    port: PortOrConfig = None,
    baud: Annotated[list[int] | None, typer.Option("--baud", help="Scan only this baud rate; may be repeated.")] = None,
    json_only: Json = False,
) -> None:
    """Find servos at every baud rate and ID; show their model, firmware, voltage, temperature and errors."""
    from hil.cli.terminal import Terminal
    from hil.cli.views.setup_view import print_ports, print_scan, scanned
    from hil.config.schema import port_url
    from hil.drivers.port import open_port
    from hil.drivers.servo_model import BAUD_RATES
    from hil.setup.scan import serial_ports
    from hil.setup.session.leftovers import scan_with_leftovers

    if port is None:
        print_ports(serial_ports(), json_only)
        return
    for each in baud or ():
        _check_baud(each)
    bauds = tuple(baud or BAUD_RATES)
    terminal = Terminal(quiet=json_only)
    opened = open_port(port_url(port), bauds[0])
    try:
        with terminal.scanning() as watch:
            heard = list(scan_with_leftovers(opened, bauds, watch))
    finally:
        opened.close()
    print(json.dumps(scanned(heard))) if json_only else print_scan(heard, port)
    if not any(each.servos for each in heard):
        raise typer.Exit(1)


def _check_baud(baud: int) -> None:
    from hil.drivers.servo_model import BAUD_RATES

    if baud not in BAUD_RATES:
        raise typer.BadParameter(f"{baud}: servos support {', '.join(map(str, BAUD_RATES))}.")


def check(config: ConfigPath, json_only: Json = False) -> None:
    """Check for anything that would prevent an experiment, and say how to fix it. Torque stays off."""
    from hil.api.check import check as check_arm
    from hil.cli.terminal import Terminal
    from hil.cli.views.setup_view import print_findings
    from hil.config.schema import load_config

    checked = load_config(config)
    with Terminal(quiet=json_only).following(config) as follow:
        report = check_arm(checked, on_progress=follow)
    if json_only:
        print(json.dumps(report.to_json()))
    else:
        print_findings(report.findings, config, has_dry_run=checked.is_chain or checked.arm.link_lengths is not None)
    if not report.ready:
        raise typer.Exit(1)


def pose(
    config: ConfigPath,
    guide: Annotated[
        bool, typer.Option("--guide", help="Ask for each joint to be moved by hand, and check its motion.")
    ] = False,
    json_only: Json = False,
) -> None:
    """Show the pose of a URDF or MJCF arm as read from the bus; with --guide, check each joint. Torque stays off."""
    from hil import fakes
    from hil.cli.views.pose_view import moved_values, pose_values, print_moved, print_pose
    from hil.config.schema import load_config
    from hil.drivers.bus import ServoBus
    from hil.errors import ConfigError
    from hil.setup.by_hand import guided, pose_of
    from hil.setup.session.leftovers import about_leftovers

    arm = load_config(config)
    if arm.arm.urdf is None:
        raise ConfigError(f"{config}: arm.urdf is missing: there is no description to compare the arm with.")
    fakes.register_for(arm.url)
    with ServoBus.connect(arm.bus) as bus:
        bus.check_identity()
        for joint, servo in bus.drives.items():
            if left := about_leftovers(servo):
                print(f"{joint.title}: {left}", file=sys.stderr)
        bus.release_held()
        here = pose_of(arm, bus.read_positions())
        if not json_only:
            print_pose(arm, here)
        ask = (lambda text: print(text, file=sys.stderr)) if json_only else print
        found = []
        for each in guided(arm, bus.read_positions, bus.port.clock, ask, bus.read_drives) if guide else ():
            found.append(each)
            if not json_only:
                print_moved(each)
    if json_only:
        print(json.dumps(pose_values(arm, here) | {"moved": [moved_values(each) for each in found]}))
    if not all(each.well for each in found):
        raise typer.Exit(1)


def setup(
    port: PortOrFile,
    servo_id: Annotated[int, typer.Option("--id", min=0, max=252, help="The servo's current ID.")],
    baud: Annotated[int, typer.Option("--baud", help="The servo's current baud rate.")] = 1_000_000,
    new_id: Annotated[int | None, typer.Option("--new-id", min=0, max=252, help="ID to set.")] = None,
    new_baud: Annotated[int | None, typer.Option("--new-baud", help="Baud rate to set.")] = None,
    return_delay_us: Annotated[
        int | None,
        typer.Option(
            "--return-delay-us", min=0, max=508, help="Return delay to set, an even number of us; recommended: 0."
        ),
    ] = None,
    secondary_id: Annotated[
        int | None,
        typer.Option(
            "--secondary-id", min=0, max=255, help="Secondary ID to set; 255, which disables it, is recommended."
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Answer yes to every question.")] = False,
    json_only: Json = False,
) -> None:
    """Set a servo's ID, baud rate, return delay or Secondary ID. Each write requires confirmation and is read back.

    First, all servos on this port are restored if a killed run left them with torque on or with its settings.
    """
    from hil.cli.views.question import agrees
    from hil.cli.views.setup_view import changed, print_changes
    from hil.config.schema import port_url
    from hil.drivers.port import open_port
    from hil.setup.servo_settings import RETURN_DELAY_UNIT_US, open_servo, set_up
    from hil.setup.session.leftovers import recover_all

    for each in (baud, new_baud):
        if each is not None:
            _check_baud(each)
    if return_delay_us is not None and return_delay_us % RETURN_DELAY_UNIT_US:
        raise typer.BadParameter(f"--return-delay-us {return_delay_us}: servos accept only even values from 0 to 508.")
    if json_only and not yes:
        raise typer.BadParameter("--json cannot ask for confirmation: add --yes.")
    opened = open_port(port_url(port), baud)
    try:
        all_restored = recover_all(opened, servo_id, lambda text: print(text, file=sys.stderr))
        servo = open_servo(opened, servo_id)
        confirm: Callable[[str], bool] = (lambda _: True) if yes else agrees
        changes = set_up(
            servo,
            confirm,
            new_id=new_id,
            new_baud=new_baud,
            return_delay_us=return_delay_us,
            secondary_id=secondary_id,
        )
    finally:
        opened.close()
    print(json.dumps(changed(changes))) if json_only else print_changes(changes, port)
    if not all_restored:
        raise typer.Exit(1)
