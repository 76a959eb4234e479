"""`jetnormal reconstruct` as a user runs it: a process, exit codes, one line on stderr, nothing left behind."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere

from jetnormal import Cloud, formats
from jetnormal.formats.meshes import read_mesh
from jetnormal.support.open3d_loader import import_open3d

pytestmark = pytest.mark.skipif(import_open3d() is None, reason="Open3D cannot be loaded")

MILK = Path(__file__).parents[2] / "samples" / "milk.pcd"
PROGRAM = (sys.executable, "-c", "from jetnormal.cli.app import main; main()")


def jetnormal(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=240)


def test_a_real_scan_becomes_a_colored_mesh(tmp_path):
    result = jetnormal("reconstruct", MILK, "-o", tmp_path / "milk.glb", "--model", "jet", "--depth", 6, "--json")
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    mesh = read_mesh(tmp_path / "milk.glb")
    assert summary["open"] and not summary["watertight"] and summary["components"] == 1
    assert summary["faces"] == len(mesh.faces) > 1000
    assert summary["seconds"]["reconstruct"] > 0
    assert np.ptp(mesh.colors, axis=0).min() > 0.5
    scan = formats.read(MILK).points
    assert np.abs(mesh.vertices.min(axis=0) - scan.min(axis=0)).max() < 0.05 * np.ptp(scan, axis=0).max()


def test_the_library_is_found_and_the_user_s_files_are_not_imported(tmp_path):
    formats.write(Cloud(sphere(500), sphere(500)), tmp_path / "in.xyz")
    (tmp_path / "json.py").write_text("raise SystemExit('imported from the current folder')")
    program = [sys.executable, "-P" if sys.version_info >= (3, 11) else "-I", *PROGRAM[1:]]
    result = subprocess.run(
        [*program, "reconstruct", "in.xyz", "-o", "out.off"], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    assert read_mesh(tmp_path / "out.off").faces.shape[0] > 100


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["missing.ply", "-o", "out.ply"], 3, "missing.ply"),
        (["few.xyz", "-o", "out.ply"], 3, "at least 10"),
        (["few.xyz", "-o", "few.xyz"], 3, "suffix"),
        (["few.xyz", "-o", "kept.obj"], 3, "--force"),
        (["few.xyz", "-o", "nowhere/out.ply"], 3, "nowhere"),
        (["line.xyz", "-o", "out.stl"], 3, "line"),
        (["few.xyz", "-o", "out.ply", "--trim", "1"], 2, "trim"),
        (["few.xyz", "-o", "out.ply", "--orient", "none"], 2, "--orient"),
        (["few.xyz", "-o", "out.ply", "--viewpoint", "1,2"], 2, "--viewpoint"),
        (["few.xyz", "-o", "out.ply", "--viewpoint-attribute", "sx,sy,sz"], 3, "'sx'"),
        (["few.xyz", "-o", "out.ply", "--model", "nonesuch"], 4, "nonesuch"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line_and_leaves_nothing(
    tmp_path, monkeypatch, program, arguments, code, words
):
    formats.write(Cloud(np.random.default_rng(0).random((9, 3))), tmp_path / "few.xyz")
    formats.write(Cloud(np.arange(90.0)[:, None] * [1, 1, 0]), tmp_path / "line.xyz")
    (tmp_path / "kept.obj").write_text("precious")
    before = sorted(tmp_path.iterdir())
    monkeypatch.chdir(tmp_path)
    model = [] if "--model" in arguments else ["--model", "pca"]
    result = program("reconstruct", *arguments, *model)
    assert result.returncode == code, result.stderr
    lines = [line for line in result.stderr.strip().splitlines() if "warning" not in line]
    assert words in lines[-1] and "Traceback" not in result.stderr
    assert code != 3 or len(lines) == 1
    assert sorted(tmp_path.iterdir()) == before


def test_estimate_makes_a_mesh_in_one_pass(tmp_path):
    formats.write(Cloud(sphere(500)), tmp_path / "in.xyz")
    result = jetnormal(
        "estimate", tmp_path / "in.xyz", "-o", tmp_path / "out.ply", "--mesh", tmp_path / "m.stl", "--model", "jet",
        "--json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["valid"] == 500 and formats.read(tmp_path / "out.ply").normals is not None
    assert summary["mesh"]["watertight"] and summary["mesh"]["faces"] == len(read_mesh(tmp_path / "m.stl").faces)


@pytest.mark.parametrize(
    ("mesh", "options", "code"), [("mesh.xyz", [], 3), ("out.ply", [], 2), ("mesh.ply", ["--orient", "none"], 2)]
)
def test_a_mesh_that_cannot_be_made_is_told_before_the_estimate(tmp_path, mesh, options, code):
    result = jetnormal("estimate", MILK, "-o", tmp_path / "out.ply", "--mesh", tmp_path / mesh, *options)
    assert result.returncode == code, result.stderr
    assert list(tmp_path.iterdir()) == []
