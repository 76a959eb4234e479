"""Virtual scanners: what they read lies on the surface, faces the sensor and is as spaced as it says."""

import numpy as np
import pytest

from jetnormal.data.mesh_sampler import MeshSampler
from jetnormal.data.scanners import rasters
from jetnormal.data.scanners.draw import FAMILIES, random_scan, scan
from jetnormal.data.scanners.range_errors import RangeErrors, smooth_noise
from jetnormal.data.scanners.targets import MeshTarget
from jetnormal.mesh import Mesh


def unit_cube() -> Mesh:
    from scipy.spatial import ConvexHull

    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    hull = ConvexHull(corners)
    faces = hull.simplices.copy()
    inward = ((np.cross(*(corners[faces[:, i]] - corners[faces[:, 0]] for i in (1, 2)))) * hull.equations[:, :3]).sum(1)
    faces[inward < 0] = faces[inward < 0][:, ::-1]
    return Mesh(corners, faces.astype(np.int64))


@pytest.fixture(scope="module")
def cube() -> MeshTarget:
    return MeshTarget(MeshSampler(unit_cube()))


def test_rays_meet_the_cube_where_they_should(cube):
    # The frame has its origin in the middle of the cube, and the cube's diagonal, sqrt(3), as its unit.
    origins = np.array([[0.1, 0.05, 2.0], [0.1, 0.05, 0.0], [0.0, 5.0, 5.0]])
    directions = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    hits = cube.cast(origins, directions)
    half = 0.5 / np.sqrt(3)
    np.testing.assert_allclose(hits.distance, [2 - half, half - 0.1, np.inf], atol=1e-12)
    # From inside the side of the sensor is the inner one.
    np.testing.assert_allclose(hits.normals, [[0, 0, 1], [-1, 0, 0], [0, 0, 0]], atol=1e-12)


def test_what_is_behind_the_cube_is_hidden(cube):
    top = np.array([[0.0, 0.0, 0.5 / np.sqrt(3)]])
    assert cube.visible(top, np.array([[0.1, 0.2, 2.0]])) == [True]
    assert cube.visible(top, np.array([[0.1, 0.2, -2.0]])) == [False]


@pytest.mark.parametrize("kind", FAMILIES)
def test_scans_lie_near_the_surface_and_face_the_sensor(cube, kind):
    for seed in range(3):
        seen = scan(cube, kind, 4000, np.random.default_rng(seed))
        assert seen.kind == kind and 100 < len(seen) <= 4000
        labeled = seen.labeled
        outside = np.maximum(np.abs(seen.points - 0.5) - 0.5, 0)
        inside = np.min(0.5 - np.abs(seen.points - 0.5), axis=1).clip(0)
        distance = np.hypot(np.linalg.norm(outside, axis=1), inside)
        assert np.sqrt(np.mean(distance[labeled] ** 2)) < 0.06  # of a cube with edges of one
        np.testing.assert_allclose(np.linalg.norm(seen.normals, axis=1), 1, atol=1e-12)
        assert ((seen.normals * (seen.sensors - seen.points)).sum(1) > 0)[labeled].mean() > 0.99
        assert labeled.mean() > 0.6


def test_a_scan_follows_from_the_generator_alone(cube):
    first, second = (random_scan(cube, 3000, np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.sensors, second.sensors)


def test_an_exact_scanner_reads_the_surface(cube):
    eye, axes = np.array([0.0, 0.0, 3.0]), np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    rng = np.random.default_rng(0)
    raster = rasters.Pinhole(eye, axes)
    window = rasters.window_of(cube, raster, 1.0, rng)
    sampling = rasters.Sampling(3000, 6.0)
    scan = rasters.read_raster("stripe", cube, raster, window, sampling, RangeErrors(3.0, grazing=0.0), rng)
    half = 0.5 / np.sqrt(3)
    np.testing.assert_allclose(scan.points[:, 2], half, atol=1e-12)
    assert 2700 < len(scan) < 3300
    # Rows and columns of the grid, six times as far apart one way as the other.
    x, y = (np.diff(np.unique(scan.points[:, axis].round(6))) for axis in (0, 1))
    assert np.ptp(x) < 3e-6 and np.ptp(y) < 3e-6
    assert y[0] / x[0] == pytest.approx(6.0, rel=0.05)


class TestRangeErrors:
    flat = np.full((60, 80), 2.0), np.ones((60, 80)), (np.full((60, 80), 0.01),) * 2

    def test_white_errors_grow_with_range_and_incidence(self):
        errors = RangeErrors(1.0, white=1e-3, range_power=2.0, grazing_power=1.0, grazing=0.0)
        distance, _, gaps = self.flat
        read = errors.read(distance, np.full_like(distance, 0.5), gaps, np.random.default_rng(0))
        assert np.std(read.distance - 2.0) == pytest.approx(1e-3 * 4 * 2, rel=0.05)

    def test_waves_are_smooth_along_rows_only(self):
        noise = smooth_noise((200, 300), (0.0, 8.0), np.random.default_rng(0))
        along = np.mean(noise[:, 1:] * noise[:, :-1])
        across = np.mean(noise[1:] * noise[:-1])
        assert along > 0.95 and abs(across) < 0.1 and np.std(noise) == pytest.approx(1)

    @pytest.mark.parametrize("disparity", [False, True])
    def test_steps(self, disparity):
        rng = np.random.default_rng(0)
        distance = rng.uniform(1.9, 2.1, (60, 80))
        errors = RangeErrors(2.0, step=0.01, disparity=disparity, grazing=0.0)
        read = errors.read(distance, *self.flat[1:], rng).distance
        values = np.unique(1 / read if disparity else read)
        np.testing.assert_allclose(np.diff(values), 0.01 / (4 if disparity else 1), rtol=1e-6)
        assert np.abs(read - distance).max() < 0.0056

    def test_mixed_pixels_lie_between_the_surfaces_and_are_not_labeled(self):
        distance = self.flat[0].copy()
        distance[:, 40:] = 3.0
        errors = RangeErrors(2.0, mixed=1.0, grazing=0.0)
        read = errors.read(distance, *self.flat[1:], np.random.default_rng(0))
        between = (read.distance > 2) & (read.distance < 3)
        assert between[:, 39:41].all() and between.sum() == 120
        assert (read.labeled == ~between).all()

    def test_a_slanted_surface_has_no_mixed_pixels(self):
        distance = np.broadcast_to(2.0 + 0.03 * np.arange(80), (60, 80))
        cosine = np.full((60, 80), np.cos(np.arctan(3.0)))
        read = RangeErrors(2.0, mixed=1.0, grazing=0.0).read(distance, cosine, self.flat[2], np.random.default_rng(0))
        assert read.labeled.all()

    def test_grazing_returns_are_lost(self):
        distance, _, gaps = self.flat
        for cosine, share in ((0.1, 0.25), (0.2, 0.5), (0.5, 1.0)):
            read = RangeErrors(2.0, grazing=0.2).read(
                distance, np.full_like(distance, cosine), gaps, np.random.default_rng(0)
            )
            assert read.returned.mean() == pytest.approx(share, abs=0.03)
