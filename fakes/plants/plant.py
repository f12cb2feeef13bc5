"""Plants, the mechanisms behind the fake servos: their interface, and how to load one.

A plant of your own is any object with the members of `Plant`, made by a function that takes the description's
`plant_options` as keywords:

    [fake]
    plant = "my_package.my_arm:make_plant"
    plant_options = { payload = 0.3 }
"""

import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Protocol, runtime_checkable

from hil.fakes.plants.arm import Arm
from hil.fakes.plants.backlash import GearedArm
from hil.fakes.plants.chain_arm import ChainArm
from hil.fakes.plants.pendulum import Pendulum
from hil.fakes.plants.two_link import TwoLink


class PlantError(ValueError):
    """A plant cannot be made, or returned an invalid state. The message says which and what is required."""


class Plant(Protocol):
    """A mechanism with one motor per joint, advanced lazily by the bus in the bus's own time.

    Angles and velocities are those of the servos' output shafts: joint 1 from the horizontal, joint 2 relative to
    link 1 (two-link arm). `current` is what really flows in each motor, after its current loop's lag.
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
        """Move on to time `until` [s] with the commanded motor currents [A] held constant from the present time on.

        Returns at once when `until` is not later than the plant's present time.
        """
        ...


@runtime_checkable
class CanJam(Protocol):
    """A plant that can hold a joint fast, for the fault `stuck_joint`."""

    def jam(self, joint: int, jammed: bool) -> None:
        """Hold joint `joint` (from 0) fast, or let it go."""
        ...


@runtime_checkable
class CanBeHeld(Protocol):
    """A plant whose joints a hand can take and move, for `hil.fakes.bus.hand`."""

    def hold(self, joint: int, velocity: float | None) -> None:
        """Take joint `joint` (from 0) and move it at `velocity` [rad/s] until told otherwise; None lets it go."""
        ...


def make_plant(arm: Arm) -> Plant:
    """The plant of this arm, at rest in its starting pose at time 0."""
    if any(drive.backlash for drive in arm.drives):
        return GearedArm(arm)
    return Pendulum(arm) if len(arm.links) == 1 else TwoLink(arm)


def make_chain(arm: ChainArm) -> Plant:
    """The plant of this spatial arm, at rest in its starting pose at time 0."""
    from hil.fakes.plants.chain import SpatialChain  # compiled: only who needs it waits for the compiler

    return SpatialChain(arm)


OWN_PLANTS = frozenset({"hil.fakes.plants.independent:make_plant", "hil.fakes.plants.mujoco_plant:make_plant"})
"""What a description may call without leave. A whitelist: `getattr` of any module here reaches what it imports."""

_leave = {"code": False}


def allow_code(allowed: bool = True) -> None:
    """Let descriptions call any function that can be imported, for the rest of this process; by default they may not.

    Who opens a file whose `plant` names a function runs that function with the file's arguments.
    """
    _leave["code"] = allowed


def load_plant(name: str, options: Mapping[str, object]) -> Plant:
    """The plant that `module:factory` makes from `options`; raises PlantError.

    Outside `OWN_PLANTS` only after `allow_code`.
    """
    if name not in OWN_PLANTS and not _leave["code"]:
        raise PlantError(
            f'plant = "{name}" is code that this file wants to run, with {dict(options)}: nothing was run. Look at it; '
            "if you trust the file, say --allow-code, or hil.fakes.allow_code() in Python. Without it a file may name "
            f"{' and '.join(sorted(OWN_PLANTS))} only"
        )
    module_name, _, factory_name = name.partition(":")
    try:
        factory = getattr(importlib.import_module(module_name), factory_name)
    except (ImportError, AttributeError, ValueError) as error:
        raise PlantError(f'plant = "{name}": {error}; write "module:factory", importable from here') from error
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
            f'plant = "{name}": its {type(plant).__name__} lacks {", ".join(missing)} of hil.fakes.plants.plant.Plant'
        )
    checked = CheckedPlant(plant, name)
    checked.check()
    return checked


class CheckedPlant:
    """A third-party plant whose state is checked after every step. Raises PlantError."""

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
        """Pass it on; PlantError when the plant cannot."""
        if not isinstance(self._plant, CanJam):
            raise PlantError(f'plant "{self._name}" has no jam(joint, jammed): a stuck joint needs it')
        self._plant.jam(joint, jammed)

    def hold(self, joint: int, velocity: float | None) -> None:
        """Pass it on; PlantError when the plant cannot."""
        if not isinstance(self._plant, CanBeHeld):
            raise PlantError(f'plant "{self._name}" has no hold(joint, velocity): the hand needs it')
        self._plant.hold(joint, velocity)

    def check(self) -> None:
        """Raise PlantError unless the state is one finite number per joint, three times."""
        for what in ("position", "velocity", "current"):
            values = getattr(self._plant, what)
            try:
                shape_is_right = len(values) == self.joints
                numbers_are_right = shape_is_right and all(math.isfinite(value) for value in values)
            except TypeError:
                shape_is_right = numbers_are_right = False
            if not shape_is_right:
                raise PlantError(
                    f'plant "{self._name}" at {self._time:g} s: {what} is {values!r}; one number for each of '
                    f"{self.joints} joints is needed"
                )
            if not numbers_are_right:
                raise PlantError(f'plant "{self._name}" at {self._time:g} s: {what} is {values!r}, which is not finite')
