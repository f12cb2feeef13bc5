"""Removal of terms that do not differ significantly from zero according to the covariance, without another fit."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from hil.estimator import linalg
from hil.estimator.arrays import Array
from hil.estimator.identify import Estimate
from hil.estimator.models.model import Model
from hil.estimator.models.terms import FRICTIONS, Option, kind_of, term_of


def without_nothings(estimate: Estimate, level: float, fixed: Option | None) -> Model:
    """Return the model without parts that do not differ significantly from zero, starting with the least significant.

    Significance is determined by A. Wald's test (Trans. AMS 54 (1943) 426): the squared distance from zero in standard
    errors, compared with chi^2 at `level`. The remaining parameters are updated with the linearised model.
    """
    return pruned_model(estimate.model, estimate.names, estimate.value, estimate.covariance, level, fixed)


def pruned_model(
    model: Model, names: Sequence[str], value: Array, covariance: Array, level: float, fixed: Option | None
) -> Model:
    """Return `model` without the parts that do not differ significantly from zero at `level`; the option `fixed` is
    kept.

    value, covariance: parameters (parameters,) and their covariance, in the order of `names`.
    """
    names, value, covariance = list(names), value.copy(), covariance.copy()
    covariance[~np.isfinite(covariance)] = 0.0
    while True:
        doubtful = []
        for part, plainer in removable_parts(model):
            at = [names.index(name) for name in _tested(model, plainer)]
            away = value[at] - np.array([term_of(names[i]).absent for i in at])
            own = linalg.pinv(covariance[np.ix_(at, at)], rcond=1e-12, hermitian=True)
            doubtful.append((float(away @ own @ away) / float(chdtri(len(at), level)), part, plainer, at, own, away))
        doubtful = [each for each in doubtful if each[0] < 1.0 and each[1] != fixed]
        if not doubtful:
            return model
        _, _, model, at, own, away = min(doubtful, key=lambda each: each[0])
        follow = covariance[:, at] @ own
        value = value - follow @ away
        covariance = covariance - follow @ covariance[at]


def removable_parts(model: Model) -> list[tuple[str, Model]]:
    """Return the removable parts of a model, each with the model without it.

    Presliding is not included, since there is no significance test for it.
    """
    parts: list[tuple[str, Model]] = [
        (option, model.without(option)) for option in sorted(model.options) if option != "presliding"
    ]
    law = FRICTIONS.index(model.friction)
    if law:
        parts.append((model.friction, replace(model, friction=FRICTIONS[law - 1])))
    return parts


def _tested(model: Model, plainer: Model) -> list[str]:
    """Return the parameters to be tested for the part that `plainer` lacks.

    Parameters that only have an effect together with others, such as a wave's period, are not tested.
    """
    lacking = [name for name in model.names if name not in plainer.names]
    return [name for name in lacking if kind_of(name) not in ("ripple_cycles", "cogging_cycles", "stribeck_velocity")]
