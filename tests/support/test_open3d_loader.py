from __future__ import annotations

import builtins
import contextlib
import logging
import os

import pytest

from jetnormal.support import open3d_loader as _open3d


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
    _open3d.import_open3d.cache_clear()
    yield messages
    _open3d.import_open3d.cache_clear()


def test_missing_libraries_are_named_once(failing_import, caplog):
    failing_import += ["libGL.so.1: cannot open shared object file"] * 2
    with caplog.at_level(logging.WARNING, logger="jetnormal"):
        assert _open3d.import_open3d() is None
        assert _open3d.import_open3d() is None
    (record,) = caplog.records
    message = record.getMessage()
    assert "\n" not in message
    for word in ("libGL.so.1", "virtual scanners", "libusb-1.0-0", "libgl1", "libegl1"):
        assert word in message
    assert len(failing_import) == 1  # the second call did not try again


def test_missing_libusb_is_taken_from_the_package(failing_import, monkeypatch, caplog):
    loaded = []
    monkeypatch.setattr(_open3d.ctypes, "CDLL", lambda path, mode: loaded.append((path, mode)))
    failing_import += ["libusb-1.0.so.0: cannot open shared object file", "libGL.so.1: no such file"]
    assert _open3d.import_open3d() is None
    assert [mode for _, mode in loaded] == [_open3d.ctypes.RTLD_GLOBAL]
    assert "libGL.so.1" in caplog.text  # the reason of the second try, not of the first
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
        _open3d._import()
    assert seen[0] == "true"
    assert "OPEN3D_DISABLE_WEB_VISUALIZER" not in os.environ
