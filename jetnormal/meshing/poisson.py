"""Screened Poisson reconstruction (Kazhdan and Hoppe, 2013) by Open3D, in a process of its own.

Open3D's solver can crash and end the process, more often on several threads. So it runs in a child process: a fresh
interpreter. A fork would lose Open3D's threads, and `multiprocessing` would run the caller's script again.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import ResourceError
from jetnormal.support.open3d_loader import import_open3d, require_open3d

logger = logging.getLogger(__name__)

# -I keeps the current folder off the path, where a file of the user's may be called like a module.
_PROGRAM = """
import json, sys
sys.path[:] = json.loads(sys.argv[1])
from jetnormal.meshing.poisson import _end_with_parent, _work
_end_with_parent()
_work(*sys.argv[2:])
"""
_INPUT, _OUTPUT = "input.npz", "output.npz"

Reconstruction = tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]


def poisson(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    depth: int,
    *,
    scale: float = 1.1,
    threads: int | None = None,
) -> Reconstruction:
    """Reconstruct a surface from oriented points; it also extends beyond where the points end.

    If the solver crashes on several threads, it is run once more on one.

    Args:
        points: (N, 3) finite coordinates.
        normals: (N, 3) unit vectors.
        depth: depth of the octree; the sides of its finest cells are 1 / 2^depth of the cube.
        scale: side of the cube over the longest side of the points' box.
        threads: None for all cores. On more than one, the order of the vertices changes from run to run.

    Returns:
        Vertices (V, 3), faces (F, 3) counter-clockwise seen from outside, and density (V,): the depth in the octree
        that matches the spacing of the points around, one more for every halving of the spacing.

    Raises:
        ResourceError: Open3D is not there, or its solver has crashed on one thread, too.
    """
    require_open3d("reconstructs surfaces")
    with tempfile.TemporaryDirectory(prefix="jetnormal-") as folder:
        np.savez(Path(folder, _INPUT), points=points, normals=normals)
        for count in dict.fromkeys((threads or -1, 1)):
            failure = _run(folder, str(depth), str(scale), str(count))
            if failure is None:
                with np.load(Path(folder, _OUTPUT)) as arrays:
                    return arrays["vertices"], arrays["faces"], arrays["densities"]
            logger.debug("Poisson solver with %d threads: %s", count, failure)
    raise ResourceError(
        f"the Poisson solver failed on {len(points)} points at depth {depth}, on one thread, too ({failure}); "
        "it may lack memory: try a smaller `depth`"
    )


def _run(*arguments: str) -> str | None:
    """Run `_work` in a child process; return what went wrong, or None."""
    command = [sys.executable, "-I", "-c", _PROGRAM, json.dumps(sys.path), *arguments]
    # An exception in here, such as an interrupt, ends the child.
    child = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace")
    if child.returncode == 0:
        return None
    if child.returncode < 0:
        return f"ended by signal {-child.returncode}"
    return next(reversed(child.stderr.strip().splitlines()), f"exit code {child.returncode}")


def _work(folder: str, depth: str, scale: str, threads: str) -> None:
    """Do the child's work: read arrays from a file, run Open3D, write arrays to a file."""
    open3d: Any = import_open3d()
    with np.load(Path(folder, _INPUT)) as arrays:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(arrays["points"]))
        cloud.normals = open3d.utility.Vector3dVector(arrays["normals"])
    mesh, densities = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=int(depth), scale=float(scale), n_threads=int(threads)
    )
    np.savez(
        Path(folder, _OUTPUT),
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.triangles, dtype=np.int64),
        densities=np.asarray(densities),
    )


def _end_with_parent() -> None:
    """Ask the system to end this process when its parent is killed (Linux only)."""
    if sys.platform == "linux":
        import ctypes
        import signal

        set_parent_death_signal = 1  # PR_SET_PDEATHSIG of prctl(2)
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
