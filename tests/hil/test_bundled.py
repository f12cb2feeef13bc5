"""Every bundled arm with a fake bus is identified as it is shipped: the examples that newcomers run first."""

from pathlib import Path

import pytest

from hil.api.experiment import identify
from hil.config.bundled import bundled_configs
from hil.config.schema import load_config


def with_a_given_torque() -> list[str]:
    """Names of the bundled fake arms whose excitation is given; pilots have tests of their own."""
    loaded = {name: load_config(path) for name, path in bundled_configs().items()}
    return [name for name, config in loaded.items() if config.fake is not None and not config.experiment.pilot]


@pytest.mark.slow
@pytest.mark.parametrize("name", with_a_given_torque())
def test_it_is_identified_as_shipped(name: str, tmp_path: Path) -> None:
    assert identify(name, out=tmp_path / "run").verdict.trust == "yes"
