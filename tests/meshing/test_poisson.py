"""The solver in its own process: what it makes, and what becomes of a crash and of an interrupt."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere

from jetnormal.errors import ResourceError
from jetnormal.meshing import poisson as module
from jetnormal.meshing.poisson import poisson
from jetnormal.support import open3d_loader
from jetnormal.support.open3d_loader import import_open3d

pytestmark = pytest.mark.skipif(import_open3d() is None, reason="Open3D cannot be loaded")


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """The folder in which temporary folders appear."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_sphere_comes_out_round_and_wound_outward(scratch):
    vertices, faces, density = poisson(sphere(1000), sphere(1000), 5, threads=1)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 1).max() < 0.05
    assert np.linalg.det(vertices[faces]).sum() / 6 == pytest.approx(4 / 3 * np.pi, rel=0.03)
    assert density.shape == (len(vertices),) and np.ptp(density) < 2
    assert list(scratch.iterdir()) == []


def test_one_thread_gives_the_same_bits_each_time():
    first, second = (poisson(sphere(500), sphere(500), 4, threads=1) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_a_crash_is_tried_again_on_one_thread(scratch, monkeypatch):
    crash = "import os, sys\nif sys.argv[-1] != '1': os.abort()\n"
    monkeypatch.setattr(module, "_PROGRAM", crash + module._PROGRAM)
    vertices, _, _ = poisson(sphere(500), sphere(500), 4, threads=2)
    assert len(vertices) > 100
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize(
    ("crash", "words"), [("import os; os.abort()", "signal 6"), ("raise RuntimeError('no luck')", "no luck")]
)
def test_a_second_crash_is_a_resource_error(scratch, monkeypatch, crash, words):
    monkeypatch.setattr(module, "_PROGRAM", crash)
    with pytest.raises(ResourceError, match=words):
        poisson(sphere(500), sphere(500), 4)
    assert list(scratch.iterdir()) == []


def test_a_missing_open3d_is_a_resource_error(monkeypatch):
    monkeypatch.setattr(open3d_loader, "_load", lambda: "it is not there")
    with pytest.raises(ResourceError, match="Open3D"):
        poisson(sphere(500), sphere(500), 4)


@pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_the_child_ends_with_its_parent(tmp_path, end):
    ready, scratch = tmp_path / "pid", tmp_path / "scratch"
    scratch.mkdir()
    program = f"""
import signal, sys
import numpy as np
from jetnormal.meshing import poisson
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
work = "import os, time; open({str(ready)!r}, 'w').write(f'{{os.getpid()}}\\\\n'); time.sleep(60)"
poisson._PROGRAM = poisson._PROGRAM.replace("_work(*sys.argv[2:])", work)
poisson.poisson(np.eye(3), np.eye(3), 4)
"""
    environment = os.environ | {"TMPDIR": str(scratch)}
    with subprocess.Popen([sys.executable, "-c", program], env=environment, stderr=subprocess.DEVNULL) as parent:
        child = wait_for_line(ready)
        parent.send_signal(end)
        parent.wait(timeout=30)
    for _ in range(100):
        if not Path(f"/proc/{child}").exists() or "Z (zombie)" in Path(f"/proc/{child}/status").read_text():
            break
        time.sleep(0.05)
    else:
        raise AssertionError(f"process {child} goes on")
    assert end == signal.SIGKILL or list(scratch.iterdir()) == []


def wait_for_line(path: Path) -> str:
    """The line that a process writes when it is ready."""
    for _ in range(1200):
        if path.exists() and path.read_text().endswith("\n"):
            return path.read_text().strip()
        time.sleep(0.05)
    raise AssertionError("the child does not begin")
