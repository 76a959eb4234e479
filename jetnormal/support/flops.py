"""Count the floating-point operations of a network while it runs."""

from __future__ import annotations

from collections.abc import Callable

from jetnormal.support.device import torch_threads


def matrix_products(work: Callable[[], object]) -> float:
    """Count the 10^9 floating point operations in the matrix products of some work, a multiply-add being two.

    The work must run on the calling thread, for the counter sees no other. Compiled loops are not counted.
    """
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    with torch.inference_mode(), torch_threads(1), FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() / 1e9
