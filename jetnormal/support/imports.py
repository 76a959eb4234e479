"""Import libraries beside other work, and without collecting garbage."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import Thread


@contextmanager
def uncollected() -> Iterator[None]:
    """Collect no garbage in the body: it makes much that stays, and looking through it takes time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def imported_meanwhile(*names: str) -> Iterator[None]:
    """Import modules in a thread while the body runs, which imports none of them itself; they are there when it ends.

    Loops that release the interpreter lock leave a core for this. What cannot be imported is reported by whoever needs
    it.
    """

    def load() -> None:
        with uncollected():
            for name in names:
                with suppress(ImportError):
                    import_module(name)

    thread = Thread(target=load, daemon=True)
    thread.start()
    try:
        yield
    finally:
        thread.join()
