"""Configurations that are installed with hil: `hil identify fake_two_link` works without a checkout."""

from difflib import get_close_matches
from pathlib import Path

from hil.fakes.names import configs_folder


def bundled_configs() -> dict[str, Path]:
    """The bundled TOML files, keyed by name."""
    return {path.stem: path for path in sorted(configs_folder().glob("*.toml"))}


def find_config(path: Path) -> Path:
    """Return `path`; if it is a bare name and no such file exists, return the bundled file with that name."""
    if not _is_name(path) or path.exists():
        return path
    return bundled_configs().get(path.name, path)


def meant(path: Path) -> str:
    """Return a hint for a `path` that does not exist: the same name with ".toml", or the names of bundled
    configurations; "" if there is no hint.
    """
    if path.suffix == "" and not path.exists() and path.with_suffix(".toml").is_file():
        return f" Did you mean {path.with_suffix('.toml')}?"
    names = list(bundled_configs())
    if path.exists() or (not _is_name(path) and path.stem not in names):
        return ""
    close = get_close_matches(path.stem, names, n=1)
    if close:
        return f" Did you mean the bundled configuration {close[0]}?"
    return f" Bundled configurations: {', '.join(names)}."


def _is_name(path: Path) -> bool:
    return path.name == str(path) and path.suffix == ""
