"""`hil fake`: serve a fake arm on a pseudo-terminal until stopped, or describe a file's fake arm."""

import shutil
import signal
import sys
from pathlib import Path

from hil.errors import ConfigError
from hil.fakes.bus.faults import FAULTS, parse_fault
from hil.fakes.bus.hand import parse_move
from hil.fakes.description import DescriptionError, FakeArm, load_fake
from hil.fakes.plants.errors import PlantError
from hil.fakes.pty_server import Counts, LinkError, PtyServer
from hil.fakes.remote_hand import NoHand, ask_hand
from hil.next_step import command
from hil.printing import result_console, say

_STATUS_EVERY_S = 0.5
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def describe_fake(config: Path, faults: list[str], moves: list[str], seed: int | None) -> None:
    """Print what the file's [fake] table describes. Raises ConfigError."""
    fake = _load(config, faults, moves, seed)
    count = max(fake.joints) + 1
    console = result_console()
    for servo, joint in zip(fake.servos, fake.joints, strict=True):
        moved = f", joint {joint + 1}" if count < len(fake.servos) else ""
        say(console, f"ID {servo.id}: {servo.model}, firmware {servo.firmware}, {servo.baud} baud{moved}")
    say(console, f"plant: {fake.plant or f'arm of {count} joint(s)'}; seed {fake.seed}")
    for fault in fake.faults:
        say(
            console,
            f"fault: {fault.kind} at {fault.at:g} s for {fault.duration:g} s, probability {fault.probability:g}",
        )
    for move in fake.moves:
        end = f"{move.to:g} rad" if move.to is not None else f"{move.ticks} ticks"
        say(console, f"hand: servo {move.servo} to {end} at {move.at:g} s, taking {move.duration:g} s")
    print(f"\nTo let any program use this arm: {command('fake', config, '--pty')}")
    say(console, f'In Python with pyserial: hil.fakes.register(), then serial_for_url("fake://{config}")')


def list_faults() -> None:
    for kind, facts in FAULTS.items():
        amount = f"; amount: {facts.allowed}, default {facts.default:g}" if facts.amount else ""
        print(f"{kind:22s} {facts.does}{amount}")


def move_by_hand(device: Path, moves: list[str], release: list[int]) -> None:
    """Release and move joints of the fake arm served at `device`. If one of the moves is impossible, no joint moves.

    Raises ConfigError, for example if the torque of a joint to be moved is on.
    """
    try:
        for servo in release:
            ask_hand(device, f"release {servo}")
        for text in moves:
            parse_move(text)
        if moves:
            ask_hand(device, f"move {' '.join(moves)}")
    except (NoHand, ValueError) as error:
        raise ConfigError(str(error)) from error


def serve_fake(
    config: Path, link: Path | None, faults: list[str], moves: list[str], seed: int | None, quiet: bool
) -> None:
    """Serve the file's fake arm on a pseudo-terminal until Ctrl-C, SIGTERM or SIGHUP. Raises ConfigError.

    Only the path of the pseudo-terminal is printed on standard output; the status line goes to standard error.
    """
    fake = _load(config, faults, moves, seed)
    try:
        server = PtyServer(fake, link)
    except (LinkError, PlantError) as error:
        raise ConfigError(str(error)) from error
    with server:
        former = {number: signal.signal(number, lambda *_: server.stop()) for number in _SIGNALS}
        try:
            print(link or server.path, flush=True)
            on_terminal = sys.stderr.isatty()
            server.serve(_Status().show if on_terminal and not quiet else None, watch_every_s=_STATUS_EVERY_S)
            if not quiet:
                start = "\n" if on_terminal else ""
                print(f"{start}{server.counts.packets} packets, {_totals(server.counts)}", file=sys.stderr)
        except (LinkError, PlantError) as error:
            raise ConfigError(str(error)) from error
        finally:
            for number, handler in former.items():
                signal.signal(number, handler)


class _Status:
    """One status line about the server, updated in place on a terminal; a file gets only the totals at the end."""

    def __init__(self) -> None:
        self._packets = 0

    def show(self, counts: Counts) -> None:
        rate = (counts.packets - self._packets) / _STATUS_EVERY_S
        self._packets = counts.packets
        text = f"{rate:.0f} packets/s, {_totals(counts)}"
        # A line that wraps could not be updated in place.
        columns = shutil.get_terminal_size().columns - 1
        print(f"\r\x1b[K{text if len(text) <= columns else text[: columns - 1] + '…'}", end="", file=sys.stderr)
        sys.stderr.flush()


def _totals(counts: Counts) -> str:
    return (
        f"{counts.damaged} damaged, {counts.collisions} collisions, {counts.faults} faults, "
        f"{counts.overruns} more than 1 ms late (worst {1e3 * counts.late_max_s:.1f} ms)"
        + (f", {counts.lost_s:.1f} s behind real time" if counts.lost_s >= 0.1 else "")
    )


def _load(config: Path, faults: list[str], moves: list[str], seed: int | None) -> FakeArm:
    try:
        fake = load_fake(config)
        added = tuple(parse_fault(text) for text in faults)
        moved = tuple(parse_move(text) for text in moves)
    except (DescriptionError, ValueError) as error:
        raise ConfigError(str(error)) from error
    ids = [servo.id for servo in fake.servos]
    for text, fault in zip(faults, added, strict=True):
        if fault.servo is not None and fault.servo not in ids:
            raise ConfigError(f'fault "{text}": servo = {fault.servo}, but the IDs in {config} are {ids}')
    for text, move in zip(moves, moved, strict=True):
        if move.servo not in ids:
            raise ConfigError(f'move "{text}": servo = {move.servo}, but the IDs in {config} are {ids}')
    return fake.model_copy(
        update={
            "faults": fake.faults + added,
            "moves": fake.moves + moved,
            "seed": fake.seed if seed is None else seed,
        },
    )
