"""One thread of linear algebra inside, what the process had outside, and work dealt out in order."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import frictrack as ft
from frictrack.base.workers import map_in_threads, one_thread


def counts() -> set[int]:
    np.linalg.norm(np.eye(2) @ np.eye(2))
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        yield


def test_one_thread_inside_and_what_was_there_before_outside() -> None:
    with one_thread():
        assert counts() == {1}
        with one_thread():
            assert counts() == {1}
        assert counts() == {1}
    assert counts() == {2}


def test_threads_come_back_after_an_error() -> None:
    with pytest.raises(ft.FrictrackError), one_thread():
        raise ft.FrictrackError("expected nothing")
    assert counts() == {2}


@pytest.mark.parametrize("told", ["1", "2", None])
def test_work_comes_back_in_order(monkeypatch: pytest.MonkeyPatch, told: str | None) -> None:
    if told is None:
        monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OMP_NUM_THREADS", told)
    names: set[int] = set()

    def square(i: int) -> int:
        names.add(threading.get_ident())
        return i * i

    assert map_in_threads(square, range(50)) == [i * i for i in range(50)]
    if told == "1":
        assert names == {threading.get_ident()}


def test_an_error_in_dealt_out_work_comes_out() -> None:
    def fails(i: int) -> int:
        raise ft.FrictrackError(f"no {i}")

    with pytest.raises(ft.FrictrackError, match="no 0"):
        map_in_threads(fails, range(3))
