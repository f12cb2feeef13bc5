"""The check of a predicted torque asks nothing of a joint at standstill that static friction leaves open."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from hil.estimator.chain.fit.stage1 import columns_of
from hil.estimator.chain.recordings import torque_error
from hil.estimator.data.fourier import PeriodicMotion
from hil.estimator.data.recording import Recording
from tests.estimator.chain.test_column_faults import LINKS, RATE, model

TIME = np.arange(1000) / RATE
COULOMB = 0.04
PERIOD = 2.0  # s: joints 2 and 3 move to and fro once, then stand still; joint 1 hardly moves


def stopped() -> tuple[Recording, Any]:
    """The recording, with exact torques, and the true parameters."""
    arm, w = model(), 2.0 * np.pi / PERIOD
    early = np.outer([0.003, 1.0, 1.0], TIME < PERIOD)
    position = early * (1.0 - np.cos(w * TIME))
    motion = PeriodicMotion(position, early * w * np.sin(w * TIME), early * w * w * np.cos(w * TIME))
    rigid = arm.base.of_all(np.column_stack((LINKS, [0.01] * 3)).reshape(-1))
    values = np.concatenate((rigid, [COULOMB] * 6, [0.0] * 3))
    recording = Recording(TIME, columns_of(arm, motion) @ values, position, np.full(3, 1e-3), "held", 0.0)
    parameters = dict(zip(arm.linear_names, values.tolist(), strict=True))
    return recording, SimpleNamespace(model=arm, cutoff=8.0, parameters=parameters)


def test_static_friction_is_no_error_and_more_is() -> None:
    recording, found = stopped()
    resting = np.outer([0.0, 1.0, 0.0], TIME > PERIOD)

    def error(torque: float) -> float:
        return float(torque_error([replace(recording, torque=recording.torque + torque * resting)], found)[1])

    assert error(0.9 * COULOMB) < error(0.0) + 0.005
    assert error(4.0 * COULOMB) > error(0.0) + 0.05
    assert np.isnan(torque_error([recording], found)[0])  # says nothing about a joint that hardly moves
