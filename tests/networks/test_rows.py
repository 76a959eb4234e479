"""Chunks of rows: shared among threads, and the same to the last digit on any number of them."""

from collections.abc import Iterator

import pytest
import torch

from jetnormal.networks import rows


@pytest.fixture
def new_pool() -> Iterator[None]:
    """Let the test begin without worker threads."""
    before = torch.get_num_threads()
    rows._pool.cache_clear()
    yield
    rows._pool().shutdown()
    rows._pool.cache_clear()
    torch.set_num_threads(before)


def test_a_worker_stays_on_one_thread_if_another_number_is_set_before_its_first_chunk(new_pool: None):
    rows._pool().submit(lambda: None).result()
    torch.set_num_threads(3)
    used = []
    rows.for_rows(lambda _: used.append(torch.get_num_threads()), 4, chunk=1)
    assert used == [1, 1, 1, 1]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_row_is_computed_once(new_pool: None, threads: int):
    torch.set_num_threads(threads)
    with torch.inference_mode():
        squares = rows.by_rows(lambda part: torch.arange(1000)[part] ** 2, 1000, chunk=64)
    assert torch.equal(squares, torch.arange(1000) ** 2)
