"""The programs in examples/ run, and do what they say."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shapes import cube, sphere

from jetnormal import Cloud, Mesh, read, write
from jetnormal.formats.meshes import write_mesh
from jetnormal.support.open3d_loader import import_open3d

ROOT = Path(__file__).parents[2]
BASH = shutil.which("bash")


def run(name: str, *arguments: object) -> str:
    """Run an example with this Python first in the path; return what it printed."""
    interpreter = BASH if name.endswith(".sh") else sys.executable
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    command = [interpreter, ROOT / "examples" / name, *arguments]
    environment = os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(list(map(str, command)), env=environment, capture_output=True, text=True, timeout=500)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.skipif(import_open3d() is None, reason="there is no Open3D")
def test_an_open3d_cloud_gets_normals():
    assert "100% of the normals look towards the camera" in run(
        "01_open3d_round_trip.py", ROOT / "samples" / "milk.pcd"
    )


@pytest.mark.skipif(BASH is None, reason="there is no bash")
def test_a_folder_is_done_once(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("a.ply", "b.xyz"):
        write(Cloud(sphere(200)), tmp_path / "in" / name)
    run("02_batch_folder.sh", tmp_path / "in", tmp_path / "out", "--model", "pca")
    written = (tmp_path / "out" / "a.ply").stat().st_mtime_ns
    (tmp_path / "out" / "b.xyz").unlink()
    run("02_batch_folder.sh", tmp_path / "in", tmp_path / "out", "--model", "pca")
    assert (tmp_path / "out" / "a.ply").stat().st_mtime_ns == written
    assert read(tmp_path / "out" / "b.xyz").normals is not None


@pytest.mark.skipif(BASH is None, reason="there is no bash")
def test_a_network_goes_on_learning_from_meshes(tmp_path):
    for folder in ("meshes", "held_out"):
        (tmp_path / folder).mkdir()
        write_mesh(Mesh(*cube()), tmp_path / folder / "cube.ply")
    sizes = {"clouds_per_epoch": 1, "crops_per_cloud": 2, "crop_points": 500, "points_per_cloud": 5000}
    tiny = [part for name, value in sizes.items() for part in ("--set", f"{name}={value}")]
    out = run("03_train_on_own_meshes.sh", tmp_path / "meshes", tmp_path / "held_out", tmp_path / "work", 1, *tiny)
    assert "cloudfit" in out and "model.safetensors" in out
    assert (tmp_path / "work" / "run" / "metrics.csv").is_file()


def test_an_e57_project_looks_towards_its_scanners(tmp_path):
    pye57 = pytest.importorskip("pye57")
    file = pye57.E57(str(tmp_path / "project.e57"), mode="w")
    for seed, position in enumerate(((3.0, 0.0, 0.0), (0.0, -3.0, 1.0))):
        points = sphere(1500, seed)
        points = points[points @ np.array(position) > 1]  # what is seen from there
        columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), (points - position).T, strict=True))
        file.write_scan_raw(columns, translation=np.array(position))
    file.close()
    out = run("04_e57_with_poses.py", tmp_path / "project.e57", tmp_path / "normals.e57")
    assert "scanner at [3.0, 0.0, 0.0]" in out and "100% of the normals look towards their scanner" in out
    again = read(tmp_path / "normals.e57")
    assert np.median(np.einsum("nd,nd->n", again.normals, again.points)) > 0.95  # a sphere seen from outside
