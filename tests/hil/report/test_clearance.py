"""The report's section on clearance: how close the recorded arm came, and which parts need no margin."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from hil.clearance.space import Space
from hil.config.schema import load_config
from hil.report.sections.clearance import clearance
from hil.runs.recording import Phase
from tests.support.paths import CONFIGS

SPATIAL, PLANAR = "viperx_300.toml", "fake_two_link.toml"


def recorded(name: str) -> Any:
    """A run of this arm: one pose of the path, and one on the way."""
    config = load_config(CONFIGS / name)
    samples = np.zeros(3, dtype=[("phase", np.int64), ("position", np.float64, (len(config.joints),))])
    samples["phase"] = Phase.REST, Phase.PERIODIC, Phase.RAMP_OUT
    if config.is_chain:
        samples["position"] = np.add(config.arm.rest_pose, [[0.0], [0.3], [0.15]])
    return SimpleNamespace(config=config, samples=samples)


def test_the_least_clearance_and_the_parts_that_need_no_margin_are_said() -> None:
    data = recorded(SPATIAL)
    space, section = Space.of(data.config), clearance(data)
    assert section is not None
    for row, pose, way in zip(section.tables[0].rows, data.samples["position"][1:], (False, True), strict=True):
        found = space.nearest(pose[:, None], way)
        assert row[1:] == (" and ".join(found.pair), f"{1e3 * found.distance:.0f} mm", f"{1e3 * found.needed:.0f} mm")
    assert space.near
    assert all(f"{first} and {second}" in section.bullets[0] for first, second in space.near)
    assert len(section.bullets) == 1 + len(space.as_built)


def test_a_planar_arm_has_none() -> None:
    assert clearance(recorded(PLANAR)) is None
