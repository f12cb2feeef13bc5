"""Fake arms by name: those shipped with hil for use by other programs, and the arms of its own configurations."""

from pathlib import Path

ARMS = Path(__file__).parent / "arms"

_PACKAGE = Path(__file__).parents[1]


def configs_folder() -> Path:
    """Where hil's own configurations lie: in the installed package, or beside it in a checkout."""
    installed = _PACKAGE / "configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "configs"


def arm_names() -> tuple[str, ...]:
    """Every name that `find_arm` knows: ready arms first, then hil's own fake arms."""
    ready = sorted(path.stem for path in ARMS.glob("*.toml"))
    return (*ready, *sorted(path.stem for path in configs_folder().glob("fake_*.toml")))


def find_arm(path: Path | str) -> Path:
    """`path` itself or, if it is a bare name and not a file, the file of the arm of that name."""
    path = Path(path)
    if path.name != str(path) or path.suffix or path.exists():
        return path
    for folder in (ARMS, configs_folder()):
        named = folder / f"{path.name}.toml"
        if named.is_file():
            return named
    return path
