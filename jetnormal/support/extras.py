"""Libraries that not every installation has."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from jetnormal.errors import ResourceError

_EXTRAS = {
    "torch": ("torch", "PyTorch"),
    "open3d": ("mesh", "Open3D"),
    "laspy": ("las", "laspy"),
    "lazrs": ("las", "lazrs"),
    "pye57": ("e57", "pye57"),
    "matplotlib": ("plots", "Matplotlib"),
    "tensorboard": ("tensorboard", "TensorBoard"),
    "onnx": ("onnx", "the package onnx"),
    "ray": ("cluster", "Ray"),
}
"""By library the extra of jetnormal that installs it, and what the library calls itself."""


def advice(library: str) -> str:
    """Return what to do where a library is missing."""
    return f"it is not installed: pip install 'jetnormal[{_EXTRAS[library][0]}]'"


def require(library: str, user: str) -> ModuleType:
    """Import a library that an extra installs.

    Args:
        library: its name in `import`.
        user: what needs the library, as the message calls it: a file, an option.

    Raises:
        ResourceError: it is missing, or cannot be loaded.
    """
    try:
        with named_extras(user):
            return importlib.import_module(library)
    except ImportError as error:
        extra, name = _EXTRAS[library]
        found = f"{user} needs {name}, but it cannot be loaded ({error})"
        raise ResourceError(f"{found}; install it again: pip install 'jetnormal[{extra}]'") from error


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
