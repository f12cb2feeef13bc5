"""The `hil` command: what each subcommand takes, and how errors become one message and an exit code.

The modules that do the work are imported inside the commands, so that `hil --help` answers at once.
"""

import json
import sys
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from hil import __version__, strict_json
from hil.cli import data as cli_data
from hil.cli import dry_run as cli_dry_run
from hil.cli import init as cli_init
from hil.cli import results as cli_results
from hil.cli import runs as cli_runs
from hil.cli import study as cli_study

if TYPE_CHECKING:
    from hil.config.schema import Config
    from hil.results.result import SettledResult

app = typer.Typer(
    name="hil",
    help="Identify the dynamics of Dynamixel servo arms, on the bus or on a fake one.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ConfigPath = Annotated[
    Path, typer.Argument(metavar="CONFIG", help="TOML file of the arm, or the name of a bundled one.")
]
PortOrConfig = Annotated[
    str | None,
    typer.Argument(metavar="[PORT]", help="Serial port or pyserial URL, or a TOML file; without it: list the ports."),
]
OutPath = Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Run folder; default runs/TIME-ARM.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object, the result, and nothing else.")]


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        print(f"hil {__version__}")
        raise typer.Exit


@app.command(epilog="Example: hil identify configs/fake_two_link.toml")
def identify(config: ConfigPath, out: OutPath = None, json_only: Json = False) -> None:
    """Excite the arm, take one settled period, print its parameters with error bars."""
    from hil.cli.terminal import Terminal
    from hil.config.schema import load_config
    from hil.estimation.settled_estimate import estimate_run
    from hil.experiment.run import run_experiment
    from hil.runs.run_folder import RunFolder

    checked = load_config(config)
    run = RunFolder.create(out or _default_folder(config), checked)
    terminal = Terminal(quiet=json_only)
    if checked.experiment.pilot:
        from hil.pilot import identify_in_steps

        with terminal.streaming(checked) as watch:
            torque, result = identify_in_steps(checked, run, config, watch, terminal.say)
        terminal.say(torque)
        cli_results.write_report(run.path)
        _show(result, checked, run.path, json_only)
        return
    with terminal.streaming(checked) as watch:
        torque = run_experiment(checked, run, config, watch)
    terminal.say(torque)
    with terminal.busy("Estimating"):
        result = estimate_run(run)
        cli_results.write_report(run.path)
    _show(result, checked, run.path, json_only)


@app.command(epilog="Example: hil record configs/fake_two_link.toml --out runs/monday")
def record(config: ConfigPath, out: OutPath = None, json_only: Json = False) -> None:
    """Play the experiment and keep its recording, for `hil estimate`."""
    from hil.cli.terminal import Terminal
    from hil.config.schema import load_config
    from hil.errors import ConfigError
    from hil.experiment.run import run_experiment
    from hil.results.json_form import to_json
    from hil.runs.recording import load_samples
    from hil.runs.run_folder import RunFolder
    from hil.runs.timing import timing

    checked = load_config(config)
    if checked.experiment.pilot:
        raise ConfigError(
            f"{config}: experiment.pilot = true: each step's torque follows from an estimate of the one before, which "
            "`hil identify` does. To record alone, give experiment.peak_torque and set pilot = false."
        )
    run = RunFolder.create(out or _default_folder(config), checked)
    terminal = Terminal(quiet=json_only)
    with terminal.streaming(checked) as watch:
        torque = run_experiment(checked, run, config, watch)
    terminal.say(torque)
    samples = load_samples(run.samples_path, len(checked.joints))
    recorded = {
        "run": str(run.path),
        "samples": len(samples),
        "timing": to_json(timing(samples, checked.experiment.rate)),
    }
    if json_only:
        print(strict_json.dumps(recorded))
        return
    print(f"Run folder: {run.path}, {len(samples)} samples.\nEstimate from it: hil estimate {run.path}")


@app.command(epilog="Example: hil estimate runs/20261121-153000-fake_two_link")
def estimate(
    run: cli_data.Runs,
    config: cli_data.ArmPath = None,
    all_samples: cli_data.AllSamples = False,
    json_only: Json = False,
) -> None:
    """Estimate again from a recording; writes its result.json anew. Or from CSV files of any motion."""
    from hil.cli.terminal import Terminal
    from hil.errors import RecordingCutShort
    from hil.estimation.settled_estimate import estimate_run
    from hil.runs.run_folder import RunFolder

    if cli_data.are_csv(run):
        cli_data.estimate_csv(run, config, json_only)
        return
    folder = RunFolder.open(run[0])
    if all_samples:
        cli_data.estimate_all_samples(folder, json_only)
        return
    terminal = Terminal(quiet=json_only)
    try:
        with terminal.busy("Estimating"):
            result = estimate_run(folder)
            cli_results.write_report(folder.path)
    except RecordingCutShort as error:
        error.add_note(f"What there is can be used without a settled period: hil estimate {folder.path} --all-samples")
        raise
    _show(result, folder.load_config(), folder.path, json_only)


@app.command(epilog="Example: hil scan /dev/ttyUSB0")
def scan(
    port: PortOrConfig = None,
    baud: Annotated[
        list[int] | None, typer.Option("--baud", help="Only this baud; may be given more than once.")
    ] = None,
    json_only: Json = False,
) -> None:
    """Find servos: every baud, every ID, with model, firmware, voltage, temperature and errors."""
    from hil.cli.setup_view import print_ports, print_scan, scanned
    from hil.cli.terminal import Terminal
    from hil.config.schema import port_url
    from hil.drivers.port import open_port
    from hil.drivers.servo_model import BAUD_RATES
    from hil.setup import scan as scanning

    if port is None:
        print_ports(scanning.serial_ports(), json_only)
        return
    bauds = tuple(baud or BAUD_RATES)
    terminal = Terminal(quiet=json_only)
    opened = open_port(port_url(port), bauds[0])
    try:
        with terminal.busy(f"Asking {len(bauds)} baud rates"):
            heard = list(scanning.scan(opened, bauds))
    finally:
        opened.close()
    print(json.dumps(scanned(heard))) if json_only else print_scan(heard, port)
    if not any(each.servos for each in heard):
        raise typer.Exit(1)


@app.command(epilog="Example: hil check configs/my_arm.toml")
def check(config: ConfigPath, json_only: Json = False) -> None:
    """Look for everything that would stop an experiment, with how to mend it. Torque stays off."""
    from hil import fakes
    from hil.cli.setup_view import found, print_findings
    from hil.cli.terminal import Terminal
    from hil.config.schema import load_config
    from hil.setup.preflight import Level, check_arm

    checked = load_config(config)
    fakes.register()
    with Terminal(quiet=json_only).busy("Looking"):
        findings = list(check_arm(checked))
    print(json.dumps(found(findings))) if json_only else print_findings(findings, config)
    if any(finding.level is Level.STOP for finding in findings):
        raise typer.Exit(1)


@app.command(
    epilog="Example: hil setup /dev/ttyUSB0 --baud 57600 --id 1 --new-id 2 --new-baud 1000000 --return-delay-us 0"
)
def setup(
    port: Annotated[str, typer.Argument(metavar="PORT", help="Serial port or pyserial URL, or a TOML file.")],
    servo_id: Annotated[int, typer.Option("--id", min=0, max=252, help="The servo's present ID.")],
    baud: Annotated[int, typer.Option("--baud", help="Its present baud.")] = 1_000_000,
    new_id: Annotated[int | None, typer.Option("--new-id", min=0, max=252)] = None,
    new_baud: Annotated[int | None, typer.Option("--new-baud")] = None,
    return_delay_us: Annotated[
        int | None, typer.Option("--return-delay-us", min=0, max=508, help="0 is wanted.")
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Answer every question with yes.")] = False,
    json_only: Json = False,
) -> None:
    """Set a servo's ID, baud or return delay: a question before each write to EEPROM, each write read back."""
    from hil.cli.setup_view import changed, print_changes
    from hil.config.schema import port_url
    from hil.drivers.port import open_port
    from hil.drivers.servo_model import BAUD_RATES
    from hil.setup.servo_settings import open_servo, set_up

    if new_baud is not None and new_baud not in BAUD_RATES:
        raise typer.BadParameter(f"{new_baud}: a servo can do {', '.join(map(str, BAUD_RATES))}.")
    if json_only and not yes:
        raise typer.BadParameter("--json asks no questions: it needs --yes.")
    opened = open_port(port_url(port), baud)
    try:
        servo = open_servo(opened, servo_id)
        confirm: Callable[[str], bool] = (lambda _: True) if yes else typer.confirm
        changes = set_up(servo, confirm, new_id=new_id, new_baud=new_baud, return_delay_us=return_delay_us)
    finally:
        opened.close()
    print(json.dumps(changed(changes))) if json_only else print_changes(changes)


app.command(epilog="Example: hil report runs/20261121-153000-fake_two_link --png pictures")(cli_results.report)
app.command(epilog="Example: hil export runs/20261121-153000-fake_two_link --format urdf --format mjcf")(
    cli_results.export
)
app.command(epilog="Example: hil init /dev/ttyUSB0 --out my_arm.toml")(cli_init.init)
app.command("dry-run", epilog="Example: hil dry-run configs/first_time.toml --picture dry_run.png")(cli_dry_run.dry_run)
app.command(epilog="Example: hil runs runs")(cli_runs.runs)
app.command(epilog='Example: hil note runs/20261121-153000-fake_two_link --text "new gearbox"')(cli_runs.note)
app.command(epilog="Example: hil diff runs/before runs/after --png wear.png")(cli_runs.diff)
app.command(epilog="Example: hil study studies/seeds.toml --workers 2")(cli_study.study)
app.command(epilog="Example: hil compare runs/20261121-153000-fake_two_link")(cli_data.compare)
app.command(epilog="Example: hil calibrate runs/bare runs/with_mass --mass 0.1 --distance 0.16 --length 0.147")(
    cli_data.calibrate
)


def _list_faults(wanted: bool) -> None:
    if wanted:
        from hil.cli import fake as fake_command

        fake_command.list_faults()
        raise typer.Exit


@app.command(epilog="Example: hil fake configs/fake_two_link.toml --pty --link /tmp/arm")
def fake(
    config: ConfigPath,
    pty: Annotated[bool, typer.Option("--pty", help="Serve it on a terminal device until Ctrl-C or SIGTERM.")] = False,
    link: Annotated[Path | None, typer.Option(metavar="PATH", help="Symbolic link to that device.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND[:KEY=VALUE,...]", help="Let this go wrong; may be repeated. See --list-faults."),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of noise and faults, instead of the file's.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No status line.")] = False,
    _: Annotated[
        bool,
        typer.Option("--list-faults", is_eager=True, callback=_list_faults, help="Print the kinds of faults and exit."),
    ] = False,
) -> None:
    """Serve the fake arm of a file to any program, in real time; without --pty, say what it is made of."""
    from hil.cli import fake as fake_command

    if pty:
        fake_command.serve_fake(config, link, fault or [], seed, quiet)
    else:
        fake_command.describe_fake(config, fault or [], seed)


def main() -> NoReturn:
    """Run the command line; a foreseen error becomes its message on standard error and its exit code."""
    try:
        app()
    except Exception as error:
        code = _exit_code(error)
        if code is None:
            raise
        print(_message(error), file=sys.stderr)
        sys.exit(code)
    sys.exit(0)


def _show(result: "SettledResult", config: "Config", path: Path, json_only: bool) -> None:
    if json_only:
        print(strict_json.dumps(result.to_json()))
        return
    from rich.console import Console

    from hil.cli.result_table import print_result

    print_result(result, config, path, Console(highlight=False))


def _default_folder(config: Path) -> Path:
    return Path("runs") / f"{datetime.now():%Y%m%d-%H%M%S}-{config.stem}"


def _exit_code(error: Exception) -> int | None:
    """The exit code of a foreseen error; None for one that is a fault of the program."""
    from hil.drivers import errors as driver
    from hil.errors import HilError
    from hil.estimator.errors import EstimationError

    if isinstance(error, HilError):
        return error.exit_code
    if isinstance(error, driver.UnknownModel | driver.PortNotOpened | driver.WrongModel | driver.WrongSetting):
        return 2
    return 1 if isinstance(error, driver.DriverError | EstimationError) else None


def _message(error: Exception) -> str:
    """What happened, what it happened on top of, and whether torque is off."""
    lines = [f"hil: {error}", *getattr(error, "__notes__", [])]
    cause = error.__context__
    if cause is not None and error.__cause__ is None and isinstance(cause, Exception) and _exit_code(cause) is not None:
        lines.append(f"This came after: {cause}")
    return "\n".join(lines)
