"""Row by row over large tensors: in chunks that stay in a core's cache, shared among threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch
from torch import Tensor

CHUNK = 4096  # rows


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,))


def by_rows(function: Callable[[slice], Tensor], count: int) -> Tensor:
    """function(rows) for the rows 0 to count of a result, put together.

    While gradients are recorded that is a single call. Otherwise the rows come in chunks, whose size does not depend
    on the number of threads (`torch.get_num_threads`), so that the result does not, either.
    """
    if torch.is_grad_enabled() or count <= CHUNK:
        return function(slice(0, count))
    chunks = [slice(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]
    first = function(chunks[0])
    out = first.new_empty(count, *first.shape[1:])
    out[chunks[0]] = first

    def work(mine: list[slice]) -> None:
        with torch.inference_mode():  # a thread has its own mode
            for rows in mine:
                out[rows] = function(rows)

    threads = torch.get_num_threads()
    if threads == 1:
        work(chunks[1:])
    else:
        list(_pool().map(work, (chunks[1 + part :: threads] for part in range(threads))))
    return out
