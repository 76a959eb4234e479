"""Clouds to meshes: spheres, an open half of one, colors, large coordinates, and what cannot be meshed."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import sphere

import jetnormal
from jetnormal import Cloud, formats, reconstruct
from jetnormal.errors import InputError, UsageError
from jetnormal.formats.meshes import read_mesh, write_mesh
from jetnormal.jobs.options import ReconstructOptions
from jetnormal.jobs.reconstruct import _fitting_depth, reconstruct_file
from jetnormal.meshing import poisson
from jetnormal.meshing.cleanup import is_watertight
from jetnormal.support.open3d_loader import import_open3d

pytestmark = pytest.mark.skipif(import_open3d() is None, reason="Open3D cannot be loaded")

UTM = np.array([456_789.0, 5_432_109.0, 321.0])


@pytest.fixture(autouse=True)
def solver_in_this_process(monkeypatch):
    """Save a second per mesh: tests/meshing/test_poisson.py and the command line's tests have the child."""
    monkeypatch.setattr(poisson, "_run", poisson._work)


def cap(count: int = 2000) -> np.ndarray:
    points = sphere(2 * count)
    return points[points[:, 2] > 0]


def enclosed(mesh: jetnormal.Mesh) -> float:
    """Volume inside a closed mesh, negative if it is wound inward."""
    return float(np.linalg.det((mesh.vertices - mesh.vertices.mean(axis=0))[mesh.faces]).sum() / 6)


def test_a_sphere_without_normals_becomes_a_closed_mesh_wound_outward():
    mesh = reconstruct(sphere(2000), model="jet", depth=5)
    assert is_watertight(mesh)
    assert enclosed(mesh) == pytest.approx(4 / 3 * np.pi, rel=0.02)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.02


def test_large_coordinates_lose_nothing():
    points = np.round(sphere(2000), 6)
    near = reconstruct(Cloud(points, points), depth=5, threads=1)
    far = reconstruct(Cloud(points + UTM, points), depth=5, threads=1)
    assert near.faces.shape == far.faces.shape
    assert np.abs(near.vertices - (far.vertices - UTM)).max() < 1e-6


def test_an_open_surface_is_cut_where_its_points_end():
    mesh = reconstruct(Cloud(cap(), cap()), depth=6)
    assert not is_watertight(mesh)
    assert -0.25 < mesh.vertices[:, 2].min() < 0.01
    assert np.linalg.norm(mesh.area_vectors(), axis=1).sum() == pytest.approx(2 * np.pi, rel=0.15)


def test_trim_overrules_what_is_decided_by_itself(tmp_path):
    formats.write(Cloud(cap(), cap()), tmp_path / "cap.ply")
    formats.write(Cloud(sphere(2000), sphere(2000)), tmp_path / "sphere.ply")

    def summary(name: str, **options: float) -> dict:
        options = ReconstructOptions(depth=5, **options)
        return reconstruct_file(tmp_path / name, tmp_path / "mesh.ply", options, overwrite=True)

    whole = summary("cap.ply", trim=0.0)
    assert whole["open"] and whole["trimmed"] == 0
    holed = summary("sphere.ply", trim=0.2)
    assert not holed["open"] and 0.1 < holed["trimmed"] < 0.4 and not holed["watertight"]


def test_colors_are_carried_to_the_mesh():
    points = sphere(2000)
    red = np.where(points[:, 0] > 0, 255, 0).astype(np.uint8)
    colors = {"red": red, "green": np.full(2000, 51, np.uint8), "blue": 255 - red}
    mesh = reconstruct(Cloud(points, points, colors), depth=5)
    clear = np.abs(mesh.vertices[:, 0]) > 0.1
    assert np.allclose(mesh.colors[clear, 0], mesh.vertices[clear, 0] > 0)
    assert np.allclose(mesh.colors[:, 1], 0.2)
    assert reconstruct(Cloud(points, points), depth=5).colors is None


def test_a_mesh_is_smoothed_and_simplified_and_keeps_its_colors():
    noisy = sphere(2000) * (1 + 0.02 * np.random.default_rng(0).normal(size=(2000, 1)))
    cloud = Cloud(noisy, sphere(2000), dict.fromkeys(("red", "green", "blue"), np.full(2000, 255, np.uint8)))
    plain = reconstruct(cloud, depth=6)
    mesh = reconstruct(cloud, depth=6, smooth=10, faces=300, min_component="largest")
    assert 200 < len(mesh.faces) <= 300 < len(plain.faces)
    assert mesh.colors.shape == mesh.vertices.shape and np.allclose(mesh.colors, 1)
    spread = [np.linalg.norm(one.vertices, axis=1).std() for one in (mesh, plain)]
    assert spread[0] < spread[1]


def test_the_depth_follows_the_spacing_of_the_points(tmp_path):
    depths = []
    for count in (300, 5000):
        formats.write(Cloud(sphere(count), sphere(count)), tmp_path / "in.ply", overwrite=True)
        summary = reconstruct_file(tmp_path / "in.ply", tmp_path / "out.ply", ReconstructOptions(), overwrite=True)
        depths.append(summary["depth"])
    assert depths == [4, 6]  # 2.2 / spacing is 10.7 and 44


def test_noise_makes_the_cells_larger():
    points, rng = sphere(5000), np.random.default_rng(0)
    noisy = points * (1 + 0.03 * rng.normal(size=(5000, 1)))
    far = np.where(points[:, :1] > 0.4, noisy, points)  # a third of them, as in the frame of a depth camera
    assert _fitting_depth(points / 2, 1.1, is_frame=False) == 6  # 1.1 / 0.025
    assert _fitting_depth(noisy / 2, 1.1, is_frame=False) == 5  # 1.1 / 0.06
    assert _fitting_depth(far / 2, 1.1, is_frame=False) == 6
    assert _fitting_depth(far / 2, 1.1, is_frame=True) == 5


def test_specks_of_outliers_vanish():
    points = np.r_[sphere(2000), [3.0, 0, 0] + 0.01 * sphere(8)]
    mesh = reconstruct(Cloud(points, np.r_[sphere(2000), sphere(8)]), depth=6, trim=0)
    assert mesh.vertices[:, 0].max() < 1.1


def test_rows_without_a_normal_are_left_out_with_a_warning(tmp_path):
    points, normals = np.r_[sphere(2000), [[np.nan] * 3, [9.0, 9, 9]]], np.r_[sphere(2000), [[0, 0, 1.0], [np.nan] * 3]]
    formats.write(Cloud(points, normals), tmp_path / "in.ply")
    summary = reconstruct_file(tmp_path / "in.ply", tmp_path / "out.ply", ReconstructOptions(depth=5))
    assert summary["warnings"] == ["2 points without finite coordinates or a normal are left out"]
    assert np.abs(read_mesh(tmp_path / "out.ply").vertices).max() < 1.1


def test_normals_of_another_length_are_used_with_a_warning(tmp_path):
    formats.write(Cloud(sphere(2000), 7 * sphere(2000)), tmp_path / "in.ply")
    summary = reconstruct_file(tmp_path / "in.ply", tmp_path / "out.ply", ReconstructOptions(depth=5))
    assert "length 1" in summary["warnings"][0] and summary["watertight"]


def test_scrambled_normals_are_told_and_recomputed_when_asked(tmp_path):
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (2000, 1))
    formats.write(Cloud(sphere(2000), sphere(2000) * signs), tmp_path / "in.ply")
    files = tmp_path / "in.ply", tmp_path / "out.ply"
    used = reconstruct_file(*files, ReconstructOptions(depth=5, model="jet"))
    assert any("opposite normals" in warning for warning in used["warnings"])
    assert any("`recompute`" in warning for warning in used["warnings"])
    again = reconstruct_file(*files, ReconstructOptions(depth=5, model="jet", recompute=True), overwrite=True)
    assert used["normals"] == "file" and again["normals"].startswith("jet")
    assert again["watertight"] and again["warnings"] == []


def test_a_mesh_given_for_a_cloud_is_told(tmp_path):
    write_mesh(reconstruct(Cloud(sphere(2000), sphere(2000)), depth=5), tmp_path / "mesh.ply")
    summary = reconstruct_file(tmp_path / "mesh.ply", tmp_path / "out.ply", ReconstructOptions(depth=5, model="jet"))
    assert "a mesh already" in summary["warnings"][0]


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (Cloud(sphere(9), sphere(9)), "at least 10"),
        (Cloud(np.repeat(sphere(9), 9, axis=0), np.repeat(sphere(9), 9, axis=0)), "at least 10"),
        (Cloud(np.arange(60.0)[:, None] * [1, 2, 3], sphere(60)), "one line"),
        (Cloud(sphere(50), np.full((50, 3), np.nan)), "`recompute`"),
        (Cloud(sphere(50), np.zeros((50, 3))), "`recompute`"),
        (Cloud(np.r_[sphere(50), [[1e300, 0, 0]]], np.r_[sphere(50), [[1.0, 0, 0]]]), r"1e\+300"),
        (Cloud(np.zeros((0, 3))), "at least 3"),
    ],
)
def test_what_suggests_no_surface_is_an_input_error_that_names_the_file(tmp_path, cloud, words):
    formats.write(cloud, tmp_path / "in.ply")
    with pytest.raises(InputError, match=words) as error:
        reconstruct_file(tmp_path / "in.ply", tmp_path / "out.ply", ReconstructOptions(model="jet"))
    assert "in.ply" in str(error.value)
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


@pytest.mark.parametrize(
    "options", [{"depth": 3}, {"depth": 13}, {"scale": 0.9}, {"scale": np.nan}, {"trim": 1.0}, {"trim": -0.1},
                {"orient": "none"}, {"smooth": -1}, {"faces": 3}, {"min_component": -1}, {"min_component": "most"},
                {"orient": "nonesuch"}, {"orient": "up", "viewpoint": (0, 0, 1)}]
)  # fmt: skip
def test_options_out_of_range_are_usage_errors(options):
    with pytest.raises(UsageError):
        ReconstructOptions(**options)


def test_a_target_that_cannot_be_written_is_told_before_any_work(tmp_path):
    (tmp_path / "mesh.ply").write_text("precious")
    for name in ("mesh.ply", "mesh.xyz", "nowhere/mesh.ply"):
        with pytest.raises(InputError):
            reconstruct_file(tmp_path / "missing.ply", tmp_path / name, ReconstructOptions())
    assert (tmp_path / "mesh.ply").read_text() == "precious"
