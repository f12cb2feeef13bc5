"""Test whether one joint's friction changed between two runs, using the full covariance of its parameters.

Friction parameters are known far better in combination than individually: a 10 % change in one of them may be smaller
than its standard error and still be obvious. Let d be the difference in the joint's friction parameters between the
runs, and S the sum of their covariances in the two runs. Two kinds of test are performed.

one term alone    Did only term i change? The most powerful test is z_i = (S^-1 d)_i / sqrt((S^-1)_ii), and
                  (S^-1 d)_i / (S^-1)_ii is the estimated change (generalised least squares).
several at once   Is d more than noise? d' S^-1 d has a chi-square distribution.

Friction itself varies slightly from run to run. The covariance of a single run does not include this, so
`REPEATABILITY` is added to S.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from hil.arm_model import ArmModel
from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.models.terms import TERMS
from hil.results.parts import Covariance

KINDS = ("viscous", "coulomb", "coulomb_width", "stribeck_rise", "stribeck_velocity", "load", "viscous_asymmetry")
"""Terms of sliding friction. They include the width of the Coulomb step: the data determine this width only together
with the Stribeck rise.
"""
REPEATABILITY = 0.005
"""Run-to-run standard deviation of a friction parameter of an unchanged arm, relative to its value."""


@dataclass(frozen=True)
class FrictionChange:
    """The friction of one joint in two runs.

    term: the single term whose change explains the difference best. before, after: its values if nothing else in the
    joint's friction changed. std: standard error of that change [unit of the term]. z: change divided by `std`. p:
    probability of a difference at least this large, in any term, if the joint is unchanged. stds: standard error of
    each term's change if only that term changed [unit of the term].
    """

    joint: int
    term: str
    before: float
    after: float
    std: float
    z: float
    p: float
    stds: Mapping[str, float]

    @property
    def name(self) -> str:
        """Name of the row in a table of changes."""
        return f"friction_{self.joint}: {self.term}"


def friction_changes(
    models: tuple[ArmModel, ArmModel], covariances: tuple[Covariance | None, Covariance | None]
) -> list[FrictionChange]:
    """Test every joint's friction for a change; joints without usable covariances in both runs are left out."""
    if covariances[0] is None or covariances[1] is None:
        return []
    kept = covariances[0], covariances[1]
    found = (_of_joint(models, kept, joint) for joint in range(1, len(models[0].joints) + 1))
    return [change for change in found if change is not None]


def _of_joint(
    models: tuple[ArmModel, ArmModel], covariances: tuple[Covariance, Covariance], joint: int
) -> FrictionChange | None:
    names = [name for kind in KINDS if _comparable(models, name := f"{kind}_{joint}")]
    values = [np.array([model.values.get(name, 0.0) for name in names]) for model in models]
    scale = np.maximum(*np.abs(values))
    spread = sum(_block(kept, model, names) for kept, model in zip(covariances, models, strict=True))
    spread = spread + np.diag(2 * (REPEATABILITY * scale) ** 2)
    usable = np.isfinite(np.diag(spread)) & (scale > 0)
    if not usable.any():
        return None
    names = [name for name, each in zip(names, usable, strict=True) if each]
    before, after, scale = (each[usable] for each in (*values, scale))
    difference = (after - before) / scale
    precision = linalg.pinv(spread[np.ix_(usable, usable)] / np.outer(scale, scale), hermitian=True)
    pushed, sharp = precision @ difference, np.diag(precision)
    z = pushed / np.sqrt(sharp)
    best = int(np.argmax(np.abs(z)))
    alone = math.erfc(abs(z[best]) / math.sqrt(2))
    together = float(chdtrc(len(names), max(difference @ pushed, 0.0)))
    change = float(pushed[best] / sharp[best] * scale[best])
    stds = dict(zip(names, (scale / np.sqrt(sharp)).tolist(), strict=True))
    # One hypothesis per term was tested, and one about all of them (Bonferroni).
    p = min(1.0, (len(names) + 1) * min(alone, together))
    level = float(before[best])
    return FrictionChange(joint, names[best], level, level + change, stds[names[best]], float(z[best]), p, stds)


def _comparable(models: Sequence[ArmModel], name: str) -> bool:
    """Whether both models have the term, or one model has it and the other implies that the term is 0."""
    having = [name in model.values for model in models]
    return all(having) or (any(having) and TERMS[name.rpartition("_")[0]].absent == 0.0 and "velocity" not in name)


def _block(kept: Covariance, model: ArmModel, names: Sequence[str]) -> Array:
    """Covariance of these parameters: zero for those that the model lacks, infinite where it is unknown."""
    found = np.zeros((len(names), len(names)))
    rows = [row for row, name in enumerate(names) if name in kept.names]
    index = [kept.names.index(names[row]) for row in rows]
    found[np.ix_(rows, rows)] = kept.array()[np.ix_(index, index)]
    for row, name in enumerate(names):
        if name in model.values and name not in kept.names:
            found[row, row] = math.inf
    return found
