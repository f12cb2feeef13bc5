"""BLAS is limited to one thread while the estimator works."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from hil.estimator.blas import one_blas_thread


def threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


@pytest.mark.skipif(not threads(), reason="numpy's BLAS has no threads that threadpoolctl knows")
def test_blas_has_one_thread_inside_and_what_it_had_after() -> None:
    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert one_blas_thread(one_blas_thread(threads))() == [1] * len(before)
        assert threads() == before


def test_errors_restore_it_too() -> None:
    @one_blas_thread
    def fails(reason: str) -> None:
        raise ValueError(reason)

    before = threads()
    with pytest.raises(ValueError, match="no motion"):
        fails("no motion")
    assert threads() == before
