"""The types that the public functions accept as a configuration. This module imports only what they need."""

from os import PathLike
from pathlib import Path

from hil.config.schema import Config, load_config

ConfigLike = str | PathLike[str] | Config
"""A TOML file, the name of a bundled configuration, or a loaded configuration."""


def loaded(config: ConfigLike) -> tuple[Config, Path]:
    """Load and check the configuration; also return its path as the caller wrote it. Raises ConfigError, TypeError."""
    if isinstance(config, Config):
        return config, config.path
    if not isinstance(config, str | PathLike):
        raise TypeError(
            "config must be a TOML file, the name of a bundled configuration or the result of hil.load_config, not "
            f"{config!r}."
        )
    return load_config(Path(config)), Path(config)
