"""The cache of compiled loops is invalidated by a change in any code or constant compiled into them."""

import subprocess
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numba
import pytest

from hil.estimator import compiled
from hil.estimator.chain.model import dynamics
from hil.estimator.compiled import code_digest
from hil.estimator.simulation import sensitivity
from hil.experiment.checks import joint_checks
from hil.fakes.plants import chain_kernel, two_link

LOOP = """
{imported}
TABLE = {table}
def inner(x): return x + {added}
def loop(x):
    def own(y): return {factor} * y
    return {call}(own(x)) + TABLE[0] + {attribute}
"""
PLAIN = {
    "imported": "LIMIT = 4.0",
    "table": "(1.0, 2.0)",
    "added": "1.0",
    "factor": "2.0",
    "call": "inner",
    "attribute": "LIMIT",
}


def loop(**changes: str) -> Callable[..., Any]:
    module = ModuleType(f"{compiled.PACKAGE}.drawn")
    exec(LOOP.format(**{**PLAIN, **changes}), module.__dict__)
    made: Callable[..., Any] = module.__dict__["loop"]
    return made


def test_the_same_code_has_the_same_digest() -> None:
    assert code_digest(loop()) == code_digest(loop())
    assert code_digest(numba.njit(loop())) == code_digest(numba.njit(loop()))


def test_the_options_of_compilation_count() -> None:
    made = [
        code_digest(numba.njit(**options)(loop()))
        for options in ({}, {"fastmath": True}, {"fastmath": {"contract"}}, {"error_model": "numpy"})
    ]
    assert len(set(made)) == 4


@pytest.mark.parametrize(
    "change",
    [
        {"added": "1.5"},
        {"factor": "3.0"},
        {"table": "(1.0, 2.5)"},
        {"imported": "LIMIT = 5.0"},
        {"call": "abs"},
        {"table": "__import__('numpy').array([1.0, 2.5])"},
    ],
    ids=str,
)
def test_a_change_of_code_or_of_a_constant_changes_the_digest(change: dict[str, str]) -> None:
    assert code_digest(loop(**change)) != code_digest(loop())


def test_code_of_other_modules_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    loops = [dynamics._regressors, sensitivity._advance, joint_checks._look]
    before = [code_digest(each) for each in loops]
    kept = [each._cache._cache_file._source_stamp for each in loops]  # type: ignore[attr-defined]
    assert kept == before
    monkeypatch.setattr(dynamics, "place", loop())
    monkeypatch.setattr(sensitivity, "GAMMA", 0.3)
    monkeypatch.setattr(joint_checks.work, "look", loop())
    assert all(code_digest(each) != was for each, was in zip(loops, before, strict=True))


def test_another_process_finds_what_was_stored() -> None:
    code = "from hil.estimator.simulation import sensitivity as s; print(s._advance._cache._cache_file._source_stamp)"
    found = {subprocess.check_output([sys.executable, "-c", code], text=True).strip() for _ in range(2)}
    assert found == {code_digest(sensitivity._advance)}


def test_loops_of_the_fakes_are_compiled_from_one_file_each() -> None:
    """They use numba's own cache, which checks the date of one file."""
    for module, function in ((chain_kernel, chain_kernel.run.py_func), (two_link, two_link._run)):  # type: ignore[attr-defined]
        assert function.__module__ == module.__name__
        used = [value for _, value in compiled._used(function)]
        functions = [compiled._plain(value) for value in used if callable(value)]
        assert functions
        assert {each.__module__ for each in functions} == {module.__name__}
