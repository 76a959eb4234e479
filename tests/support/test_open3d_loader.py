from __future__ import annotations

import builtins
import contextlib
import os
import sys

import pytest

from jetnormal.errors import ResourceError
from jetnormal.support import open3d_loader


@pytest.fixture
def failing_import(monkeypatch):
    """Let `import open3d` fail with the given messages, one per try, and succeed after that."""
    messages: list[str] = []
    real = builtins.__import__

    def import_or_fail(name, *arguments, **options):
        if name == "open3d" and messages:
            raise ImportError(messages.pop(0))
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", import_or_fail)
    open3d_loader._load.cache_clear()
    yield messages
    open3d_loader._load.cache_clear()


def test_missing_libraries_are_named(failing_import):
    failing_import += ["libGL.so.1: cannot open shared object file"] * 2
    assert open3d_loader.import_open3d() is None
    with pytest.raises(ResourceError) as raised:
        open3d_loader.require_open3d("draws meshes")
    message = str(raised.value)
    assert "\n" not in message
    for word in ("draws meshes", "libGL.so.1", "libusb-1.0-0", "libgl1", "libegl1"):
        assert word in message
    assert len(failing_import) == 1  # the second call did not try again


def test_a_missing_package_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    open3d_loader._load.cache_clear()
    with pytest.raises(ResourceError, match=r"casts rays, but it is not installed: pip install 'jetnormal\[mesh\]'"):
        open3d_loader.require_open3d("casts rays")
    open3d_loader._load.cache_clear()


def test_missing_libusb_is_taken_from_the_package(failing_import, monkeypatch):
    loaded = []
    monkeypatch.setattr(open3d_loader.ctypes, "CDLL", lambda path, mode: loaded.append((path, mode)))
    failing_import += ["libusb-1.0.so.0: cannot open shared object file", "libGL.so.1: no such file"]
    assert open3d_loader.import_open3d() is None
    assert [mode for _, mode in loaded] == [open3d_loader.ctypes.RTLD_GLOBAL]
    with pytest.raises(ResourceError, match=r"libGL\.so\.1"):  # the reason of the second try, not of the first
        open3d_loader.require_open3d("draws meshes")
    assert failing_import == []


def test_the_web_viewer_stays_off_and_the_environment_as_it_was(monkeypatch):
    seen = []
    real = builtins.__import__

    def note(name, *arguments, **options):
        if name == "open3d":
            seen.append(os.environ.get("OPEN3D_DISABLE_WEB_VISUALIZER"))
        return real(name, *arguments, **options)

    monkeypatch.delenv("OPEN3D_DISABLE_WEB_VISUALIZER", raising=False)
    monkeypatch.setattr(builtins, "__import__", note)
    with contextlib.suppress(ImportError):
        open3d_loader._import()
    assert seen[0] == "true"
    assert "OPEN3D_DISABLE_WEB_VISUALIZER" not in os.environ
