"""Workers shared by the tests of studies: it takes longer to start one than to do its work."""

from collections.abc import Iterator

import pytest

from hil.study.engine import workers
from hil.study.schema import EngineTable


@pytest.fixture(scope="session")
def cluster(_own_state: None) -> Iterator[str]:
    """Address of a scheduler with two workers on this machine."""
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'hil[study]'")
    with workers(EngineTable(), None, 2) as client:
        yield client.scheduler.address  # type: ignore[union-attr]
