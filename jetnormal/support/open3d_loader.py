"""The one place that imports Open3D, which may be absent or lack system libraries."""

from __future__ import annotations

import ctypes
import os
import threading
from functools import cache
from types import ModuleType

from jetnormal.errors import ResourceError
from jetnormal.support.extras import advice

_lock = threading.Lock()


def import_open3d() -> ModuleType | None:
    """Import Open3D, or return None where it cannot be loaded."""
    loaded = _load()
    return None if isinstance(loaded, str) else loaded


def require_open3d(task: str) -> ModuleType:
    """Import Open3D for a task of its own, such as "draws meshes".

    Raises:
        ResourceError: it cannot be loaded.
    """
    loaded = _load()
    if isinstance(loaded, str):
        raise ResourceError(f"Open3D {task}, but {loaded}")
    return loaded


@cache
def _load() -> ModuleType | str:
    """Open3D, or why it is not there and what to do.

    One thread imports at a time: two that do so together can see a module without its contents.

    Open3D's Linux wheels link to libusb, which many machines lack: the copy that the package libusb-package
    carries is loaded then. libGL and libEGL have no such stand-in.
    """
    with _lock:
        try:
            return _import()
        except ImportError as error:
            failure = error
        if "libusb" in str(failure) and _load_packaged_libusb():
            try:
                return _import()
            except ImportError as error:
                failure = error
    if isinstance(failure, ModuleNotFoundError) and failure.name == "open3d":
        return advice("open3d")
    return (
        f"it cannot be loaded ({str(failure).partition(chr(10))[0]}); install the system libraries libusb-1.0, libGL "
        "and libEGL (Debian, Ubuntu: apt install libusb-1.0-0 libgl1 libegl1)"
    )


def _import() -> ModuleType:
    """Import Open3D without its web viewer, of which it tells on stdout in a notebook."""
    name = "OPEN3D_DISABLE_WEB_VISUALIZER"
    before = os.environ.get(name)
    os.environ[name] = "true"
    try:
        import open3d
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
    return open3d


def _load_packaged_libusb() -> bool:
    """Load the libusb of the package libusb-package so that later libraries find its symbols."""
    try:
        import libusb_package
    except ImportError:
        return False
    path = libusb_package.get_library_path()
    if path is None:
        return False
    try:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    except OSError:  # such as a limit on memory
        return False
    return True
