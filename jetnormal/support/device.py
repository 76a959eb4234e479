"""Where networks run: devices and threads."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

from jetnormal.errors import ResourceError, UsageError

_In = TypeVar("_In")
_Out = TypeVar("_Out")


def resolve_device(text: str) -> str:
    """Translate the device that a user asked for into PyTorch's name.

    Args:
        text: "auto" (the first CUDA device, else the CPU), "cpu", "cuda" or "cuda:N".

    Raises:
        UsageError: the text is none of these.
        ResourceError: there is no such CUDA device.
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", text):
        raise UsageError(f"{text!r} is no device: give auto, cpu, cuda or cuda:N")
    if text == "cpu":
        return text
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if text == "auto":
        return "cuda" if count else "cpu"
    if int(text.partition(":")[2] or 0) >= count:
        raise ResourceError(f"there is no device {text}, only {count} CUDA devices; give `device=cpu` or auto")
    return text


def available_cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def multiplies_bfloat16(device: str) -> bool:
    """Tell whether a device is a CPU that multiplies bfloat16 matrices faster than float32 ones."""
    import torch

    capabilities: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()  # newer versions have it
    return device == "cpu" and any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))


def _note_fork() -> None:
    """In a forked child, remember how many threads PyTorch had."""
    global _threads_before_fork
    torch = sys.modules.get("torch")
    if torch is not None:
        _threads_before_fork = torch.get_num_threads()


_threads_before_fork: int | None = None
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


@contextmanager
def torch_threads(threads: int | None) -> Iterator[None]:
    """Run PyTorch on a number of CPU threads inside the block; None leaves it alone.

    In a forked child it runs on one: OpenMP's threads do not outlive a fork, and waiting for them would never end.
    """
    import torch

    before = torch.get_num_threads()
    if _threads_before_fork is not None:
        threads = 1
    if threads:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def use_one_torch_thread() -> None:
    """Let PyTorch run on one thread in this thread, whatever number another one sets later; for the start of workers.

    In each new thread, PyTorch's first operation takes over the number that was set last, by any thread. Asking for
    the number counts as an operation, so it is asked before the number is set.
    """
    import torch

    torch.get_num_threads()
    torch.set_num_threads(1)


@contextmanager
def worker_pool(threads: int | None) -> Iterator[ThreadPoolExecutor]:
    """As many threads, or PyTorch's number for None, in each of which PyTorch itself runs on one.

    PyTorch gives threads that begin later the number that was set last, so that is restored at the end.
    """
    import torch

    count = threads or _threads_before_fork or torch.get_num_threads()
    with torch_threads(None), ThreadPoolExecutor(count, initializer=use_one_torch_thread) as pool:
        yield pool


def in_order(pool: ThreadPoolExecutor, function: Callable[[_In], _Out], arguments: Iterable[_In]) -> Iterator[_Out]:
    """Map a function over arguments in order, like the pool's own map; an interrupt drops what has not begun."""
    futures = [pool.submit(function, argument) for argument in arguments]
    try:
        for future in futures:
            yield future.result()
    finally:
        for future in futures:
            future.cancel()
