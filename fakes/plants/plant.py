"""Interface and loading of plants, i.e. of the mechanisms that the fake servos drive.

A custom plant is any object with the members of `Plant`, created by a function that takes the description's
`plant_options` as keyword arguments:

    [fake]
    plant = "my_package.my_arm:make_plant"
    plant_options = { payload = 0.3 }
"""

import importlib
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

from hil.fakes.plants.arm import Arm
from hil.fakes.plants.backlash import GearedArm
from hil.fakes.plants.chain_arm import ChainArm
from hil.fakes.plants.errors import PlantError
from hil.fakes.plants.pendulum import Pendulum
from hil.fakes.plants.two_link import TwoLink


class Plant(Protocol):
    """A mechanism with one motor per joint. The bus advances it only as needed, in the bus's own time.

    Angles and velocities are those of the servos' output shafts: joint 1 is measured from the horizontal, joint 2
    relative to link 1 (two-link arm). `current` is the actual motor current, after the current loop's lag.
    """

    @property
    def joints(self) -> int: ...

    @property
    def position(self) -> Sequence[float]:
        """Joint angles [rad]."""
        ...

    @property
    def velocity(self) -> Sequence[float]:
        """Joint velocities [rad/s]."""
        ...

    @property
    def current(self) -> Sequence[float]:
        """Motor currents [A]."""
        ...

    def advance(self, until: float, current: Sequence[float]) -> None:
        """Advance to time `until` [s] with constant commanded motor currents [A].

        Returns immediately if `until` is not later than the plant's current time.
        """
        ...


@runtime_checkable
class CanJam(Protocol):
    """A plant that can block a joint, for the fault `stuck_joint`."""

    def jam(self, joint: int, jammed: bool) -> None:
        """Block joint `joint` (counted from 0), or release it."""
        ...


@runtime_checkable
class CanBeHeld(Protocol):
    """A plant whose joints a hand can grip and move, for `hil.fakes.bus.hand`."""

    def hold(self, joint: int, velocity: float | None) -> None:
        """Grip a joint (counted from 0) and move it at `velocity` [rad/s] until the next call; None releases it."""
        ...


@runtime_checkable
class HasRotors(Protocol):
    """A plant whose rotors do not always move with the output shafts, because its gears have backlash."""

    @property
    def rotor_velocity(self) -> Sequence[float]:
        """Velocities of the rotors, referred to the joints [rad/s]; they determine the motors' back-EMF."""
        ...


def make_plant(arm: Arm) -> Plant:
    """Return the plant of this planar arm, at rest in its initial pose at time 0."""
    if any(drive.backlash for drive in arm.drives):
        return GearedArm(arm)
    return Pendulum(arm) if len(arm.links) == 1 else TwoLink(arm)


def make_chain(arm: ChainArm) -> Plant:
    """Return the plant of this spatial arm, at rest in its initial pose at time 0."""
    from hil.fakes.plants.chain import SpatialChain  # imported here because it is compiled on first use

    return SpatialChain(arm)


OWN_PLANTS = frozenset({"hil.fakes.plants.independent:make_plant", "hil.fakes.plants.mujoco_plant:make_plant"})
"""Factories that a description may name without special permission.

Only these exact names are allowed, since `getattr` on a module of hil also reaches whatever that module imports.
"""

_leave = {"code": False}


def allow_code(allowed: bool = True) -> None:
    """Permit descriptions to call any importable function for the rest of this process; this is off by default.

    The reason is that opening a file whose `plant` names a function runs that function with the file's arguments.
    """
    _leave["code"] = allowed


_searched: list[str] = []
"""Folders added to sys.path because a TOML file in them names a plant."""


def load_plant(name: str, options: Mapping[str, object], folder: Path | None = None) -> Plant:
    """Create a plant by calling `module:factory` with these options; raises PlantError.

    Factories outside `OWN_PLANTS` require `allow_code`. folder: additional folder in which to look for the module.
    """
    if name not in OWN_PLANTS and not _leave["code"]:
        raise PlantError(
            f'plant = "{name}": this file would run this code with {dict(options)}; nothing was run. Inspect the code; '
            "if you trust the file, use --allow-code, or hil.fakes.allow_code() in Python. Otherwise, only "
            f"{' and '.join(sorted(OWN_PLANTS))} are allowed"
        )
    module_name, _, factory_name = name.partition(":")
    if folder is not None and str(folder) not in sys.path:
        sys.path.append(str(folder))
        _searched.append(str(folder))
    try:
        module = importlib.import_module(module_name)
        factory = getattr(module, factory_name)
    except (ImportError, AttributeError, ValueError) as error:
        where = "" if folder is None else f", or one in {folder}"
        text = f'plant = "{name}": {error}; give "module:factory" with an importable module{where}'
        raise PlantError(text) from error
    found = Path(getattr(module, "__file__", None) or "")
    if folder and folder != found.parent and str(found.parent) in _searched and (folder / found.name).is_file():
        raise PlantError(
            f'plant = "{name}": this process has already loaded {found}, not the module in {folder}; rename one of them'
        )
    try:
        plant = factory(**options)
    except PlantError:
        raise
    except Exception as error:
        raise PlantError(f'plant = "{name}" with {dict(options)}: {type(error).__name__}: {error}') from error
    missing = [
        member for member in ("joints", "position", "velocity", "current", "advance") if not hasattr(plant, member)
    ]
    if missing:
        raise PlantError(
            f'plant = "{name}": its {type(plant).__name__} lacks {", ".join(missing)}, required by '
            "hil.fakes.plants.plant.Plant"
        )
    checked = CheckedPlant(plant, name)
    checked.check()
    return checked


class CheckedPlant:
    """A third-party plant whose state is checked after every step; raises PlantError."""

    def __init__(self, plant: Plant, name: str) -> None:
        self._plant = plant
        self._name = name
        self._time = 0.0

    @property
    def joints(self) -> int:
        return self._plant.joints

    @property
    def position(self) -> Sequence[float]:
        return self._plant.position

    @property
    def velocity(self) -> Sequence[float]:
        return self._plant.velocity

    @property
    def current(self) -> Sequence[float]:
        return self._plant.current

    def advance(self, until: float, current: Sequence[float]) -> None:
        self._plant.advance(until, current)
        self._time = until
        self.check()

    def jam(self, joint: int, jammed: bool) -> None:
        """Block or release a joint; raises PlantError if the plant does not support this."""
        if not isinstance(self._plant, CanJam):
            raise PlantError(f'plant "{self._name}" has no jam(joint, jammed), needed by the fault stuck_joint')
        self._plant.jam(joint, jammed)

    def hold(self, joint: int, velocity: float | None) -> None:
        """Grip, move or release a joint; raises PlantError if the plant does not support this."""
        if not isinstance(self._plant, CanBeHeld):
            raise PlantError(f'plant "{self._name}" has no hold(joint, velocity), needed to move a joint by hand')
        self._plant.hold(joint, velocity)

    def check(self) -> None:
        """Raise PlantError unless position, velocity and current each have one finite number per joint."""
        for what in ("position", "velocity", "current"):
            values = getattr(self._plant, what)
            try:
                shape_is_right = len(values) == self.joints
                numbers_are_right = shape_is_right and all(math.isfinite(value) for value in values)
            except TypeError:
                shape_is_right = numbers_are_right = False
            if not shape_is_right:
                raise PlantError(
                    f'plant "{self._name}" at {self._time:g} s: {what} is {values!r}; it must be '
                    f"one number for each of the plant's joints ({self.joints})"
                )
            if not numbers_are_right:
                raise PlantError(f'plant "{self._name}" at {self._time:g} s: {what} is {values!r}, which is not finite')
