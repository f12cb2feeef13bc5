"""Configurations that are installed with hil: `hil identify fake_two_link` works without a checkout."""

from pathlib import Path

from hil.fakes.names import configs_folder


def bundled_configs() -> dict[str, Path]:
    """The bundled TOML files by name."""
    return {path.stem: path for path in sorted(configs_folder().glob("*.toml"))}


def find_config(path: Path) -> Path:
    """Return `path`, or the bundled file of that name if `path` is a bare name and no such file exists."""
    is_name = path.name == str(path) and path.suffix == ""
    if not is_name or path.exists():
        return path
    return bundled_configs().get(path.name, path)
