"""Test of encoder zeros that a fit holds fixed."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import chain as bench
from hil.estimator.chain.fit.held_zeros import HeldZeros
from hil.estimator.chain.identify import LARGE_ZERO, doubtful_zeros, identify_chain
from hil.estimator.chain.model.chain_model import ChainModel


def test_a_zero_that_gravity_reveals_is_doubted_and_right_ones_are_not() -> None:
    setup = bench.set_up(bench.BENCHES[4], 1)
    period = bench.record(bench.BENCHES[4], setup, bench.path_of(bench.BENCHES[4], setup, 101, 5.0))
    model = ChainModel(setup.base)
    assert identify_chain(period, model, setup.prior, test_zeros=True).doubtful_zeros == ()
    shifted = period.position.copy()
    shifted[2] -= 0.025
    wrong = identify_chain(replace(period, position=shifted), model, setup.prior, test_zeros=True)
    ((joint, by),) = wrong.doubtful_zeros
    assert joint == 3
    assert by == pytest.approx(0.025, abs=0.005)


def test_only_significant_and_large_zeros_are_doubted() -> None:
    shift = np.array([0.02, -0.03, 0.5 * LARGE_ZERO])
    assert doubtful_zeros(HeldZeros(shift, 40.0), 0.8) == ((2, 0.02), (3, -0.03))
    assert doubtful_zeros(HeldZeros(shift, 10.0), 0.8) == ()
    assert doubtful_zeros(HeldZeros(shift, 40.0), 3.0) == ()  # a model error of the same size may mimic them
    assert doubtful_zeros(None, 1.0) == ()
