"""pytest fixtures with fake Dynamixel arms. pytest finds this plugin automatically if hil is installed.

    def test_my_driver(fake_arm):
        port = fake_arm()                          # a pyserial port to two XM430-W350s, IDs 1 and 2, in virtual time
        my_driver(port).ping(1)
        assert not port.bus.servos[1].torque_enabled

    def test_my_program(fake_pty):
        arm = fake_pty("arm.toml")                 # a terminal device, in real time, for any program
        subprocess.run(["my_program", arm.path], check=True)
        with arm.lock:
            assert arm.bus.servos[1].hardware_error == 0

Both accept the path of a TOML file with a [fake] table, the name of a bundled arm ("koch", "viperx_300",
"open_manipulator_x"), a `hil.fakes.description.FakeArm`, or nothing for the default arm. `seed` and `faults` override
those of the description.

pytest loads this module in every session, so it imports only what pytest itself needs.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:  # so that pytest starts as fast as without this plugin
    from hil.fakes.bus.faults import Fault
    from hil.fakes.description import FakeArm
    from hil.fakes.protocol_fake import FakeSerial
    from hil.fakes.pty_server import PtyServer

_SERVO = {"model": "XM430-W350", "zero_ticks": 2048}
_LINK = {"length": 0.15, "mass": 0.2, "centre": 0.08, "inertia": 5e-4}
_DRIVE = {
    "mass": 0.082,
    "rotor_inertia": 8e-8,
    "gear_ratio": 353.5,
    "torque_constant": 1.8,
    "current_lag": 1e-3,
    "viscous": 0.045,
    "coulomb": 0.05,
    "stribeck_rise": 0.4,
}
_DEFAULT = {
    "servos": [{"id": 1, **_SERVO, "zero_ticks": 3072}, {"id": 2, **_SERVO}],
    "arm": {"start": [-1.5707963, 0.0], "links": [_LINK, _LINK], "drives": [_DRIVE, _DRIVE]},
}


def default_arm() -> "FakeArm":
    """Return a two-link arm hanging at rest, driven by two XM430-W350s with IDs 1 and 2 at 1 MBd."""
    from hil.fakes.description import FakeArm

    return FakeArm.model_validate(_DEFAULT)


@pytest.fixture
def fake_arm() -> Iterator[Callable[..., "FakeSerial"]]:
    """Return a function that opens pyserial ports to fake arms in virtual time; they are closed after the test."""
    from hil.fakes.protocol_fake import open_fake

    with ExitStack() as opened:

        def make(
            arm: "FakeArm | Path | str | None" = None,
            *,
            seed: int | None = None,
            faults: "Sequence[Fault]" = (),
            baud: int = 1_000_000,
            timeout_s: float | None = 0.1,
        ) -> "FakeSerial":
            port = open_fake(_described(arm, seed, faults), baud=baud, timeout_s=timeout_s)
            opened.callback(port.close)
            return port

        yield make


@pytest.fixture
def fake_pty() -> Iterator[Callable[..., "PtyServer"]]:
    """Return a function that starts fake arms on terminal devices in real time, served by threads during the test."""
    from hil.fakes.pty_server import PtyServer

    with ExitStack() as opened:

        def make(
            arm: "FakeArm | Path | str | None" = None,
            *,
            seed: int | None = None,
            faults: "Sequence[Fault]" = (),
            link: Path | None = None,
        ) -> PtyServer:
            server = opened.enter_context(PtyServer(_described(arm, seed, faults), link))
            thread = Thread(target=server.serve, name="fake arm", daemon=True)
            thread.start()
            opened.callback(thread.join)
            opened.callback(server.stop)
            return server

        yield make


def _described(arm: "FakeArm | Path | str | None", seed: int | None, faults: "Sequence[Fault]") -> "FakeArm":
    from hil.fakes.description import load_fake

    if arm is None:
        arm = default_arm()
    elif isinstance(arm, str | Path):
        arm = load_fake(arm)
    update: dict[str, object] = {"faults": (*arm.faults, *faults)}
    if seed is not None:
        update["seed"] = seed
    return arm.model_copy(update=update)
