"""The one place that imports Open3D, which may be absent or lack system libraries."""

from __future__ import annotations

import ctypes
import logging
import os
import threading
from functools import cache
from types import ModuleType

logger = logging.getLogger(__name__)
_lock = threading.Lock()


@cache
def import_open3d() -> ModuleType | None:
    """Import Open3D, or return None and warn once where it cannot be loaded.

    One thread imports at a time: two that do so together can see a module without its contents.

    Open3D's Linux wheels link to libusb, which many machines lack: the copy that the package libusb-package
    carries is loaded then. libGL and libEGL have no such stand-in.
    """
    with _lock:
        return _import_or_warn()


def _import_or_warn() -> ModuleType | None:
    try:
        return _import()
    except ImportError as error:
        reason = str(error)
    if "libusb" in reason and _load_packaged_libusb():
        try:
            return _import()
        except ImportError as error:
            reason = str(error)
    logger.warning(
        "Open3D cannot be loaded (%s): meshes, pictures of them and virtual scanners need it. "
        "It needs the system libraries libusb-1.0, libGL and libEGL "
        "(Debian, Ubuntu: apt install libusb-1.0-0 libgl1 libegl1)",
        reason.partition("\n")[0],
    )
    return None


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
