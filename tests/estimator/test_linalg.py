"""No LinAlgError leaves the estimator: equations that cannot be solved are an outcome of the fit."""

import re

import numpy as np
import pytest

from hil.estimator import linalg
from hil.estimator.errors import ConvergenceError
from hil.estimator.fit.segmented_least_squares import minimise_segmented
from tests.support.paths import ROOT

UNSOLVABLE = {
    "cholesky": (-np.eye(2),),
    "inv": (np.zeros((2, 2)),),
    "least_squares": (lambda x: np.full(2, np.nan), np.ones(2)),
    "lstsq": (np.full((2, 2), np.nan), np.ones(2)),
    "pinv": (np.full((2, 2), np.nan),),
    "solve": (np.zeros((2, 2)), np.ones(2)),
    "svd": (np.full((2, 2), np.nan),),
}


@pytest.mark.parametrize("name", UNSOLVABLE)
def test_equations_that_cannot_be_solved_are_a_failed_fit(name: str) -> None:
    with pytest.raises(ConvergenceError, match="cannot be solved"):
        getattr(linalg, name)(*UNSOLVABLE[name])


def test_a_wrong_call_is_no_failed_fit() -> None:
    with pytest.raises(ValueError, match="method"):
        linalg.least_squares(lambda x: x, np.ones(2), method="none")


def test_a_step_that_cannot_be_computed_ends_the_fit() -> None:
    """Each segment's normal equations are finite, but not their sum."""

    def residual(segment: int, shared: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.ones(3)

    def derivative(segment: int, shared: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return residual(segment, shared, own), np.diag([6e153, 6e153, 1.0])

    with np.errstate(all="ignore"), pytest.raises(ConvergenceError, match="cannot be solved"):
        minimise_segmented(residual, derivative, np.ones(2), np.ones((9, 1)), 1e-3)


def test_nothing_calls_numpys_decompositions_directly() -> None:
    names = "|".join(linalg.__all__)
    direct = re.compile(
        rf"np\.linalg\.({names})\(|from (numpy|scipy)\.linalg|import scipy\.linalg|"
        r"scipy\.optimize import least_squares|polynomial\.polyfit"
    )
    files = [*(ROOT / "estimator").rglob("*.py"), *(ROOT / "hil" / "estimation").rglob("*.py")]
    assert len(files) > 100
    found = [file for file in files if file.name != "linalg.py" and direct.search(file.read_text(encoding="utf-8"))]
    assert found == []
