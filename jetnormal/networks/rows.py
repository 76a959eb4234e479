"""Loops over the rows of large tensors, in chunks that fit into a core's cache, shared among threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import torch
from torch import Tensor

from jetnormal.support.device import use_one_torch_thread

CHUNK = 4096  # rows
CUDA_CHUNK = 65_536


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), initializer=use_one_torch_thread)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child does not inherit threads


def for_rows(work: Callable[[slice], object], count: int, chunk: int = CHUNK) -> None:
    """Call work(rows) for the rows 0 to count, in chunks whose size does not depend on the number of threads.

    There are at most `torch.get_num_threads` threads; within each, PyTorch uses one thread, for which numbers a vector
    instruction takes, and with it their last digits, depend on the number of threads.
    """
    chunks = [slice(start, min(start + chunk, count)) for start in range(0, count, chunk)]
    threads = torch.get_num_threads()
    inference, gradients = torch.is_inference_mode_enabled(), torch.is_grad_enabled()

    def several(mine: list[slice]) -> None:
        with torch.inference_mode(inference), torch.set_grad_enabled(gradients):  # a thread has its own modes
            for rows in mine:
                work(rows)

    if threads == 1:
        several(chunks)
    else:
        list(_pool().map(several, (chunks[part::threads] for part in range(min(threads, len(chunks))))))


def by_rows(function: Callable[[slice], Tensor], count: int, chunk: int = CHUNK) -> Tensor:
    """Compute function(rows) for the rows 0 to count, and concatenate the results.

    While gradients are recorded this is a single call, otherwise `for_rows` makes the calls.
    """
    if torch.is_grad_enabled() or not count:
        return function(slice(0, count))
    like = function(slice(0, 1))
    if like.is_cuda:  # fewer and larger kernels, in order
        step = max(chunk, CUDA_CHUNK)
        return torch.cat([function(slice(start, start + step)) for start in range(0, count, step)])
    out = like.new_empty(count, *like.shape[1:])

    def work(rows: slice) -> None:
        out[rows] = function(rows)

    for_rows(work, count, chunk)
    return out
