"""Named fake arms: those shipped for use by other programs, and those of hil's own configurations."""

from pathlib import Path

ARMS = Path(__file__).parent / "arms"

_FAKE = "\n[fake]"
_PACKAGE = Path(__file__).parents[1]


def configs_folder() -> Path:
    """Return the folder of hil's own configurations; in a checkout, hil/configs is a link to configs/."""
    return (_PACKAGE / "configs").resolve()


def arm_names() -> tuple[str, ...]:
    """Return the names of all fake arms: those for other programs first, then those of hil's own configurations."""
    ready = sorted(path.stem for path in ARMS.glob("*.toml"))
    own = sorted(path.stem for path in configs_folder().glob("*.toml") if _FAKE in path.read_text(encoding="utf-8"))
    return (*ready, *(name for name in own if name not in ready))


def find_arm(path: Path | str) -> Path:
    """Return `path` itself or, if it is a bare name and not a file, the file of the arm with that name."""
    path = Path(path)
    if path.name != str(path) or path.suffix or path.exists():
        return path
    for folder in (ARMS, configs_folder()):
        named = folder / f"{path.name}.toml"
        if named.is_file():
            return named
    return path
