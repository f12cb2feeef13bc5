"""The registry of terms, as used by fits, results, reports, exports and the configuration."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.config.experiment import ModelConfig
from hil.estimation.model_from_config import wanted_model
from hil.estimator.errors import ModelError
from hil.estimator.fit.reparametrisation import Coordinates, Sizes, scales_of
from hil.estimator.models.model import Model
from hil.estimator.models.parameters import ABSENT, CONSTANTS, Physics, place_of
from hil.estimator.models.terms import (
    DRIVES,
    FRICTIONS,
    OPTIONS,
    TERMS,
    Drive,
    Option,
    base_names,
    extra_names,
    joint_of,
    kind_of,
    term_of,
    units_of,
)
from hil.estimator.options import CoordinateOptions

models = st.builds(
    Model,
    st.sampled_from((1, 2)),
    st.sampled_from(FRICTIONS),
    st.sampled_from(tuple(DRIVES)),
    st.sets(st.sampled_from([option for option in get_args(Option) if option != "torque_scale"])),
)


def test_every_part_of_a_model_is_declared() -> None:
    assert set(get_args(Option)) == set(OPTIONS)
    assert set(get_args(Drive)) == set(DRIVES)
    parts = {"base", "voltage", *FRICTIONS, *OPTIONS, *(term for terms in DRIVES.values() for term in terms)}
    assert {term.part for term in TERMS.values()} == parts


def test_every_term_says_what_it_is() -> None:
    for term in TERMS.values():
        assert term.unit
        assert term.meaning
        assert (term.range == "share") == (term.share_of is not None)
        assert term.scope == "joint" or term.first_joint == 1


def test_every_option_is_a_key_of_the_configuration() -> None:
    for option, words in OPTIONS.items():
        assert ModelConfig.model_fields[option].description == words
        assert option in wanted_model(ModelConfig(friction="stribeck", **{option: True}), 2).options


def test_names_with_and_without_joints() -> None:
    assert kind_of("ripple_sin_2") == "ripple_sin"
    assert joint_of("ripple_sin_2") == 2
    assert kind_of("viscous_11") == "viscous"
    assert joint_of("viscous_11") == 11
    assert kind_of("coupling") == "coupling"
    assert joint_of("lag") is None
    assert units_of(("viscous_1", "load_2", "lag")) == ("N m s/rad", "1", "s")
    with pytest.raises(ModelError, match="dahl_1"):
        term_of("dahl_1")


@given(models)
def test_a_model_has_only_declared_terms_each_once(model: Model) -> None:
    assert len(set(model.names)) == len(model.names) == len(model.units)
    assert set(model.names) <= {*base_names(model.joints), *extra_names(model.joints)}
    assert ("coulomb_width_1" in model.names) != ("presliding" in model.options)
    simulated = {name for name in model.names if term_of(name).simulated}
    assert simulated <= set(CONSTANTS)


@given(models)
def test_initial_guesses_lie_in_range_and_coordinates_map_back(model: Model) -> None:
    coordinates = Coordinates(model.names, scales_of(model.names, Sizes(0.3, 2.0, 0.02)), CoordinateOptions(1e-4))
    scale = scales_of(model.names, Sizes(0.3, 2.0, 0.02))
    value = np.array([term_of(name).initial or 0.5 * each for name, each in zip(model.names, scale, strict=True)])
    x = coordinates.coordinates(value)
    assert np.allclose(coordinates.coordinates(coordinates.values(x)), x)
    changed = np.diag([1e-6] * x.size)
    slopes = np.stack([(coordinates.values(x + d) - coordinates.values(x - d)) / 2e-6 for d in changed], axis=1)
    assert np.allclose(slopes, coordinates.slopes(x), rtol=1e-5, atol=1e-9)


def test_what_a_model_lacks_is_simulated_as_absent() -> None:
    physics = Physics.of({"viscous_2": 0.04, "lag": 1e-3})
    assert physics.vector[place_of("viscous") + 1] == 0.04
    others = [name for name in CONSTANTS if name != "viscous_2"]
    assert all(physics.vector[CONSTANTS.index(name)] == ABSENT[name] for name in others)


def test_options_are_added_and_taken_away() -> None:
    model = Model(2, "stribeck", "lag").having("ripple", "zeros")
    assert model.options == {"ripple", "zeros"}
    assert model.without("ripple") == Model(2, "stribeck", "lag", {"zeros"})
    assert model.description == "stribeck + ripple + zeros + lag"
    with pytest.raises(ModelError, match="two joints"):
        Model(1, options={"torque_scale"})
    with pytest.raises(ModelError, match="'dither'"):
        Model(1, options={"dither"})  # type: ignore[arg-type]
