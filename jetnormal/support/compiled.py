"""Functions compiled by numba at their first call, and kept for the next process where that is possible."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function of numbers and arrays; it runs without the interpreter lock.

    Sums may be reordered and products fused, but NaN and infinity are respected. The machine code is kept beside
    the module, else in the user's cache folder; where neither can be written, each process compiles anew.
    """
    from numba import njit

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz"}}
    try:
        return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no place for its cache
        return njit(**options)(function)
