"""How many threads kernels take."""

from __future__ import annotations

import numba
import pytest

from coec.geometry.compiler import on_one_thread


def test_one_thread_for_a_while_and_then_as_many_as_before() -> None:
    before = numba.get_num_threads()
    with on_one_thread():
        assert numba.get_num_threads() == 1
        with on_one_thread():
            assert numba.get_num_threads() == 1
        assert numba.get_num_threads() == 1
    assert numba.get_num_threads() == before


def test_work_that_fails_gives_its_threads_back() -> None:
    before = numba.get_num_threads()

    @on_one_thread()
    def fail() -> None:
        raise ValueError(numba.get_num_threads())

    for _ in range(2):
        with pytest.raises(ValueError, match=r"^1$"):
            fail()
    assert numba.get_num_threads() == before
