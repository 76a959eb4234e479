"""Libraries that not every installation has."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from jetnormal.errors import ResourceError

_EXTRAS = {"torch": ("torch", "PyTorch"), "open3d": ("mesh", "Open3D")}
"""By library the extra of jetnormal that installs it, and what the library calls itself."""


def advice(library: str) -> str:
    """Return what to do where a library is missing."""
    return f"it is not installed: pip install 'jetnormal[{_EXTRAS[library][0]}]'"


@contextmanager
def named_extras(user: str = "this command") -> Iterator[None]:
    """Let the failed import of a library name the extra that installs it.

    Args:
        user: what imports the library, as the message calls it.

    Raises:
        ResourceError: a library that is an extra is missing.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in _EXTRAS:
            raise
        raise ResourceError(f"{user} needs {_EXTRAS[error.name][1]}, but {advice(error.name)}") from error
