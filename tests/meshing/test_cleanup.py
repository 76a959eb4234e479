"""Cutting and cleaning meshes, asserted on a grid and on a cube."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import sphere

from jetnormal.mesh import Mesh
from jetnormal.meshing import cleanup
from jetnormal.support.open3d_loader import import_open3d

needs_open3d = pytest.mark.skipif(import_open3d() is None, reason="Open3D cannot be loaded")
CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
     [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def grid(count: int = 11) -> Mesh:
    """The unit square in count x count vertices."""
    axis = np.linspace(0, 1, count)
    vertices = np.stack([*np.meshgrid(axis, axis), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()[:, None]
    return Mesh(vertices, np.concatenate([np.add(corner, [0, 1, count]), np.add(corner, [1, count + 1, count])]))


def area(mesh: Mesh) -> float:
    return float(np.linalg.norm(mesh.area_vectors(), axis=1).sum())


def test_a_cube_is_watertight_and_an_open_or_inconsistent_one_is_not():
    assert cleanup.is_watertight(Mesh(CUBE, CUBE_FACES))
    assert not cleanup.is_watertight(Mesh(CUBE, CUBE_FACES[1:]))
    assert not cleanup.is_watertight(Mesh(CUBE, np.r_[CUBE_FACES[1:], CUBE_FACES[:1, ::-1]]))
    assert not cleanup.is_watertight(Mesh(CUBE, np.zeros((0, 3), dtype=np.int64)))


@pytest.mark.parametrize("threshold", [0.0, 0.31, 0.5, 0.99])
def test_clipping_cuts_faces_along_the_threshold(threshold):
    mesh = grid()
    kept = cleanup.cleaned(cleanup.clip(mesh, mesh.vertices[:, 0], threshold))
    assert area(kept) == pytest.approx(1 - threshold)
    assert kept.vertices[:, 0].min() == pytest.approx(threshold)
    assert (kept.area_vectors()[:, 2] >= 0).all()  # still wound the same way
    columns = np.unique(np.round(kept.vertices[:, 0], 9))
    assert len(kept.vertices) <= 11 * len(columns) + 10  # neighbors share the vertices on the cut


def test_clipping_aslant_keeps_the_area_of_the_polygon():
    mesh = grid()
    assert area(cleanup.clip(mesh, mesh.vertices @ [1, 1, 0], 1.0)) == pytest.approx(0.5)
    assert area(cleanup.clip(mesh, mesh.vertices @ [1, 1, 0], 3.0)) == 0


def test_cleaning_merges_vertices_and_drops_what_is_degenerate_doubled_or_loose():
    mesh = grid(4)
    soup = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3))
    spoiled = Mesh(
        np.r_[soup.vertices, [[9.0, 9, 9], [0.5, 0.5, 0]]],
        np.r_[soup.faces, [[0, 0, 1]], soup.faces[:1], [[0, 1, 0]]],
    )
    clean = cleanup.cleaned(spoiled)
    assert len(clean.vertices) == 16 and len(clean.faces) == 18
    assert area(clean) == pytest.approx(1)


def test_a_face_on_a_line_is_degenerate():
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 1, 3]]))
    clean = cleanup.cleaned(mesh)
    assert len(clean.faces) == 1 and len(clean.vertices) == 3


def test_specks_go_and_what_many_points_belong_to_stays():
    far = Mesh(np.r_[CUBE, CUBE * 0.1 + 5, CUBE + 10], np.r_[CUBE_FACES, CUBE_FACES + 8, CUBE_FACES + 16])
    rng = np.random.default_rng(0)
    points = np.r_[rng.random((500, 3)), rng.random((20, 3)) * 0.1 + 5, rng.random((500, 3)) + 10]
    kept = cleanup.without_specks(far, points)
    assert cleanup.component_labels(kept).max() == 1
    assert len(kept.vertices) == 16 and kept.vertices.max() == 11
    assert len(cleanup.without_specks(far, points[:20]).faces) == 12  # of a tiny cloud, the largest stays


def test_a_gap_in_the_points_is_bridged_by_the_surface_there():
    mesh = grid(101)
    points = grid(41).vertices
    points = points[(points[:, 0] < 0.3) | (points[:, 0] > 0.7)]
    gap, radius = 0.45, 0.05  # the eighth neighbor beside the gap, in a grid with spacing 0.025, is 0.05 away
    share = cleanup.gap_share(mesh, cleanup.remoteness(mesh.vertices, points))
    assert share == pytest.approx(gap - 2 * cleanup.GAP_RADII * radius, abs=0.03)
    assert cleanup.gap_share(mesh, cleanup.remoteness(mesh.vertices, grid(41).vertices)) == 0


def test_a_stray_point_supports_nothing():
    """Above a scanned street some single points hang in the air; the lid that Poisson puts over it is a gap."""
    stray = np.array([[0.5, 0.5, 1.0]])
    remote = cleanup.remoteness(np.r_[stray, [[0.5, 0.5, 0.0]]], np.r_[grid(41).vertices, stray])
    assert remote[0] > cleanup.GAP_RADII and remote[1] == 0


def test_uneven_density_is_no_gap():
    sparse, dense = grid(41).vertices, grid(201).vertices
    points = np.r_[sparse[sparse[:, 0] >= 0.3], dense[dense[:, 0] < 0.3]]
    mesh = grid(101)
    assert cleanup.gap_share(mesh, cleanup.remoteness(mesh.vertices, points)) < cleanup.OPEN_SHARE


def test_values_are_carried_exactly_at_points_and_between_them_within_their_range():
    points = grid(11).vertices
    values = points[:, :1] * 2
    assert np.allclose(cleanup.carried(values, points, points), values, atol=1e-3)
    between = cleanup.carried(values, points, grid(31).vertices)
    assert np.abs(between - grid(31).vertices[:, :1] * 2).max() < 0.11


def bumpy_sphere() -> Mesh:
    from scipy.spatial import ConvexHull
    from shapes import even_sphere

    points = even_sphere(2000)
    faces = ConvexHull(points).simplices.astype(np.int64)
    inward = np.einsum("fd,fd->f", Mesh(points, faces).area_vectors(), points[faces[:, 0]]) < 0
    faces[inward] = faces[inward, ::-1]
    return Mesh(points * (1 + 0.01 * np.random.default_rng(0).normal(size=(2000, 1))), faces)


@needs_open3d
def test_smoothing_takes_the_bumps_and_not_the_size():
    rough, smooth = bumpy_sphere(), cleanup.smoothed(bumpy_sphere(), 20)
    radius = [np.linalg.norm(mesh.vertices, axis=1) for mesh in (rough, smooth)]
    assert radius[1].std() < radius[0].std() / 2
    assert radius[1].mean() == pytest.approx(1, abs=0.003)
    assert np.array_equal(smooth.faces, rough.faces)


@needs_open3d
def test_simplifying_keeps_the_shape_with_fewer_faces():
    mesh = cleanup.simplified(bumpy_sphere(), 500)
    assert 400 < len(mesh.faces) <= 500 and cleanup.is_watertight(mesh)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.08
    assert cleanup.simplified(mesh, 500) is mesh


@pytest.mark.parametrize(("least", "left"), [(None, 2), (0, 3), (31, 2), (150, 1), (10_000, 1), ("largest", 1)])
def test_components_stay_by_the_points_that_they_have(least, left):
    rng = np.random.default_rng(0)
    meshes = [grid(5) for _ in range(3)]
    vertices = np.concatenate([mesh.vertices + np.array([3 * place, 0, 0]) for place, mesh in enumerate(meshes)])
    faces = np.concatenate([mesh.faces + 25 * place for place, mesh in enumerate(meshes)])
    counts = (300, 100, 20)
    points = np.concatenate([np.c_[rng.random((n, 2)), np.zeros(n)] + [3 * i, 0, 0] for i, n in enumerate(counts)])
    kept = cleanup.without_specks(Mesh(vertices, faces), points, least)
    assert cleanup.component_labels(kept).max() + 1 == left
    assert kept.vertices[:, 0].min() == 0  # the largest stays


def test_in_a_large_cloud_specks_are_larger():
    points = np.c_[np.random.default_rng(0).random((30_000, 2)), np.zeros(30_000)]
    speck = np.c_[np.random.default_rng(1).random((50, 2)), np.zeros(50)] + [3, 0, 0]
    two = Mesh(
        np.r_[grid(5).vertices, grid(5).vertices + np.array([3, 0, 0])], np.r_[grid(5).faces, grid(5).faces + 25]
    )
    assert cleanup.component_labels(cleanup.without_specks(two, np.r_[points, speck])).max() == 0


@pytest.mark.parametrize("noise", [0.0, 0.005, 0.02])
def test_noise_is_told_from_curvature(noise):
    points = sphere(2000) * (1 + noise * np.random.default_rng(1).normal(size=(2000, 1)))
    assert cleanup.noise(3 * points, 0.5) == pytest.approx(3 * noise, rel=0.15, abs=0.001)
