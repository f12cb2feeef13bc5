"""The wheel as built by `pip`, shared by all tests of the project."""

from pathlib import Path

import pytest

from tests.support.packages import build
from tests.support.paths import ROOT


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))
