"""Control tables: the registers of each servo model and their addresses.

The tables are not copied here but read from the `.model` files of the `dynamixel-sdk` package (one per model,
tab-separated).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType

from hil.drivers.errors import NoControlTables, UnknownModel

_SIGNED = frozenset(
    {
        "Homing Offset",
        "Goal PWM",
        "Goal Current",
        "Goal Velocity",
        "Goal Position",
        "Present PWM",
        "Present Current",
        "Present Load",
        "Present Velocity",
        "Present Position",
        "Velocity Trajectory",
        "Position Trajectory",
    }
)


@dataclass(frozen=True, slots=True)
class Register:
    """One entry of a control table; `size` is in bytes."""

    name: str
    address: int
    size: int

    @property
    def signed(self) -> bool:
        """Whether the value is in two's complement. The `.model` files mark only some of the signed registers."""
        return self.name in _SIGNED

    def encode(self, value: int) -> bytes:
        """Return the value as bytes; raises OverflowError if it does not fit."""
        return value.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        return int.from_bytes(data, "little", signed=self.signed)


@dataclass(frozen=True, slots=True)
class ControlTable:
    """All registers of one model, by name. `number` is the model number returned by a ping."""

    model: str
    number: int
    registers: Mapping[str, Register]

    def __getitem__(self, name: str) -> Register:
        return self.registers[name]

    def __contains__(self, name: object) -> bool:
        return name in self.registers

    def defines(self, address: int) -> bool:
        """Whether the byte at this address belongs to a register."""
        return any(each.address <= address < each.address + each.size for each in self.registers.values())


def _folder() -> Path:
    # find_spec does not import the package, which would load far more than the data files.
    spec = find_spec("dynamixel_easy_sdk")
    folder = None if spec is None or spec.origin is None else Path(spec.origin).parent / "control_table"
    if folder is None or not (folder / "dynamixel.model").is_file():
        raise NoControlTables(_what_is_installed())
    return folder


def _what_is_installed() -> str:
    """Return the reason why there are no control tables, and the remedy."""
    needed = "hil reads the servos' control tables from the package dynamixel-sdk, version 4.1 or newer"
    try:
        installed = version("dynamixel-sdk")
    except PackageNotFoundError:
        return f"{needed}, which is not installed. Install hil again, with its dependencies."
    return (
        f"{needed}, but {installed} is installed, probably because another package needs an older version. Give hil an "
        'environment of its own and start its fake arms with hil fake --pty: see docs/fake_bus_in_ci.md, "Programs '
        'that need an older dynamixel-sdk".'
    )


@cache
def model_names() -> Mapping[int, str]:
    """Return the model names as printed on the servos, by model number, for every model with a control table.

    Raises NoControlTables.
    """
    names: dict[int, str] = {}
    for line in (_folder() / "dynamixel.model").read_text(encoding="utf-8").splitlines()[1:]:
        number, _, file = line.partition("\t")
        if file:
            names[int(number)] = file.strip().removesuffix(".model").upper().replace("_", "-")
    return MappingProxyType(names)


@cache
def load_control_table(model: str) -> ControlTable:
    """Return the control table of a model, e.g. "XM430-W350"; raises UnknownModel, NoControlTables."""
    for number, name in model_names().items():
        if name == model.upper():
            file = _folder() / f"{name.lower().replace('-', '_')}.model"
            registers = _read_registers(file)
            return ControlTable(name, number, MappingProxyType(registers))
    raise UnknownModel(f"Unknown servo model {model!r}. Known: {', '.join(sorted(model_names().values()))}.")


def _read_registers(file: Path) -> dict[str, Register]:
    _, _, section = file.read_text(encoding="utf-8").partition("[control table]")
    registers: dict[str, Register] = {}
    for line in section.splitlines():
        fields = line.strip().split("\t")
        if len(fields) == 3 and fields[0].isdigit():
            address, size, name = int(fields[0]), int(fields[1]), fields[2]
            registers[name] = Register(name, address, size)
    return registers
