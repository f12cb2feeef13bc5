"""Compiled code is cached wherever the user may write, and compiled without a cache where that is nowhere."""

import os
from pathlib import Path
from typing import Any

import numba
import pytest
from numba.core import caching

from hil.estimator.compiled import compiled, own_folder


def doubled(x: float) -> float:
    return 2.0 * x


@pytest.fixture(autouse=True)
def read_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Neither the package's folder nor the user's cache folder can be written to, as in many containers."""
    implementation: Any = caching.CacheImpl
    named_by_user = [each for each in implementation._locator_classes if "UserProvided" in each.__name__]
    assert len(named_by_user) == 1
    monkeypatch.setattr(implementation, "_locator_classes", named_by_user)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "", raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def test_the_temporary_folder_is_used_if_no_other_can_be_written_to(tmp_path: Path) -> None:
    function: Any = compiled(doubled)
    assert function(2.0) == 4.0
    assert list(Path(own_folder()).rglob("*.nbi")) and own_folder().startswith(str(tmp_path))


@pytest.mark.parametrize("kind", ["open to others", "a link", "a file"])
def test_a_folder_that_others_may_write_to_is_not_used(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"hil-compiled-{os.getuid()}"
    if kind == "open to others":
        path.mkdir()
        path.chmod(0o777)
    elif kind == "a link":
        (tmp_path / "there").mkdir(mode=0o700)
        path.symlink_to(tmp_path / "there")
    else:
        path.touch()
    assert own_folder() == ""
    function: Any = compiled(doubled)
    assert function(2.0) == 4.0


def test_code_that_is_in_no_file_is_compiled_without_a_cache() -> None:
    names: dict[str, Any] = {}
    exec("def tripled(x):\n    return 3.0 * x", names)
    names["tripled"].__module__ = __name__
    function: Any = compiled(names["tripled"])
    assert function(2.0) == 6.0
