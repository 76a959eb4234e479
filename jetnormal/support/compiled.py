"""Functions compiled by numba at their first call, and kept for the next process where that is possible."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function of numbers and arrays; it runs without the interpreter lock.

    Sums may be reordered and products fused, but NaN and infinity mean what they mean. The machine code is kept in the
    user's cache folder (or where NUMBA_CACHE_DIR says), else beside the module: an uninstallation would leave it there.
    Where neither can be written, each process compiles anew.
    """
    from numba import njit

    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz"}}
    try:
        with _cache_folder():
            return njit(cache=True, **options)(function)
    except RuntimeError:  # numba found no place for its cache
        return njit(**options)(function)


def is_kept(function: Any) -> bool:
    """Whether the machine code of a `compiled` function is there from an earlier process."""
    folder = function.stats.cache_path
    module = function.py_func.__module__.rpartition(".")[2]
    return folder is not None and any(Path(folder).glob(f"{module}.{function.py_func.__name__}-*.nbi"))


@contextmanager
def _cache_folder() -> Iterator[None]:
    """Have numba, which looks at its setting when a function is decorated, keep code in the user's cache folder."""
    import numba

    config: Any = numba.config
    before = config.CACHE_DIR
    config.CACHE_DIR = before or str(_user_cache() / "jetnormal" / "numba")
    try:
        yield
    finally:
        config.CACHE_DIR = before


def _user_cache() -> Path:
    """Where programs of this user keep what they can make again."""
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home())
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
