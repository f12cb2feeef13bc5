"""Links of an exported spatial arm are only computed from groups of parameters that this version also forms."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from hil.config.schema import load_config
from hil.errors import ExportError
from hil.estimator.chain.model.base_parameters import BaseParameters
from hil.export.chain_links import _same_groups, chain_links
from hil.plan.chain_model import known_chain
from tests.support.paths import CONFIGS


@pytest.fixture(scope="module")
def base() -> BaseParameters:
    return known_chain(load_config(CONFIGS / "leg.toml")).base


def groups_of(base: BaseParameters) -> dict[str, str]:
    return dict(zip(base.names, base.groups, strict=True))


def test_groups_that_differ_by_rounding_are_the_same(base: BaseParameters) -> None:
    groups = groups_of(base)
    assert _same_groups(base, groups)
    factor, name = next((word, n) for n, group in groups.items() for word in group.split() if word[0].isdigit())
    assert _same_groups(base, groups | {name: groups[name].replace(factor, f"{float(factor) * (1 + 1e-6)!r}")})
    assert not _same_groups(base, groups | {name: groups[name].replace(factor, f"{float(factor) * 1.01!r}")})
    assert not _same_groups(base, groups | {name: name})
    assert not _same_groups(base, {other: group for other, group in groups.items() if other != name})


def test_a_run_with_other_groups_has_to_be_estimated_again(base: BaseParameters) -> None:
    config = load_config(CONFIGS / "leg.toml")
    groups = groups_of(base)
    name = max(groups, key=lambda each: len(groups[each]))
    values = dict.fromkeys(base.names, 0.01)
    geometry = SimpleNamespace(
        **{key: np.array(getattr(base.chain, key)) for key in ("rotation", "translation", "axis", "gravity")}
    )
    model = SimpleNamespace(
        joints=config.joints, geometry=geometry, values=values, stds=values, groups=groups | {name: name}
    )
    source = SimpleNamespace(run=Path(CONFIGS), result=SimpleNamespace(chain=SimpleNamespace(urdf="leg.urdf")))
    with pytest.raises(ExportError, match="estimate again"):
        chain_links(cast("Any", source), cast("Any", model))
