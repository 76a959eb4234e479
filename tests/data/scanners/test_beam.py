"""The stripe of light of a triangulating scanner, against closed forms."""

import numpy as np
import pytest

from jetnormal.data.mesh_sampler import MeshSampler
from jetnormal.data.scanners import rasters
from jetnormal.data.scanners.beam import REACH, Camera, seen_stripe
from jetnormal.data.scanners.range_errors import RangeErrors
from jetnormal.data.scanners.targets import MeshTarget
from jetnormal.mesh import Mesh

ROWS, COLUMNS, GAP, WIDTH = 40, 60, 0.01, 2.0


def read(distance, normals, slope=1.5, axis=1):
    camera = Camera(np.array([0.5, 0.0, 0.0]), axis, slope)
    return seen_stripe(distance, normals, np.ones_like(distance), np.full_like(distance, GAP), WIDTH, camera)


def facing(normal):
    return np.broadcast_to(np.asarray(normal, dtype=float), (ROWS, COLUMNS, 3))


def light(steps):
    return np.exp(-0.5 * (np.asarray(steps) / WIDTH) ** 2)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilted_plane_stays_where_it_is(axis):
    normal = np.array([0.6, 0.0, 0.8])
    distance = 2.0 + 0.75 * GAP * np.broadcast_to(np.arange(COLUMNS), (ROWS, COLUMNS))
    seen = read(distance, facing(normal), axis=axis)
    inner = slice(6, -6)
    np.testing.assert_allclose(seen.distance[inner, inner], distance[inner, inner], atol=1e-12)
    np.testing.assert_allclose(seen.normals, facing(normal), atol=1e-12)


@pytest.mark.parametrize("slope", [2.0, -2.0])
def test_an_edge_curls_by_the_middle_of_the_light_that_is_left(slope):
    distance = np.full((ROWS, COLUMNS), 2.0)
    distance[:, 30:] = np.inf  # nothing there
    seen = read(distance, facing([0, 0, 1]), slope=slope)
    for column in (29, 28, 25):
        steps = np.arange(-int(np.ceil(REACH * WIDTH)), 29 - column + 1)
        middle = GAP * (steps * light(steps)).sum() / light(steps).sum()
        np.testing.assert_allclose(seen.distance[:, column], 2.0 + slope * middle, atol=1e-12)
    np.testing.assert_allclose(seen.distance[:, 10], 2.0, atol=1e-12)
    assert np.isinf(seen.distance[:, 30:]).all()


def test_a_jump_of_depth_parts_the_light():
    distance = np.full((ROWS, COLUMNS), 2.0)
    distance[:, 30:] = 2.0 + 100 * GAP
    alone = distance.copy()
    alone[:, 30:] = np.inf
    near = slice(0, 30)
    seen, expected = read(distance, facing([0, 0, 1])), read(alone, facing([0, 0, 1]))
    np.testing.assert_array_equal(seen.distance[:, near], expected.distance[:, near])


def test_a_crease_becomes_round_and_so_do_its_normals():
    offset = np.arange(COLUMNS) - 30.0
    distance = 2.0 + 0.5 * GAP * np.broadcast_to(np.abs(offset), (ROWS, COLUMNS))
    left, right = np.array([-1.0, 0, 2]) / np.sqrt(5), np.array([1.0, 0, 2]) / np.sqrt(5)
    normals = np.where((offset < 0)[None, :, None], left, right) * np.ones((ROWS, 1, 1))
    seen = read(distance, normals, slope=0.0)
    steps = np.arange(-5, 6)
    np.testing.assert_allclose(seen.distance[0, 30], 2.0 + 0.5 * GAP * np.average(np.abs(steps), weights=light(steps)))
    turn = seen.normals[0, :, 0]
    assert (np.diff(turn) > -1e-12).all() and abs(turn[30]) < 0.2  # between the two, -0.45 and 0.45
    np.testing.assert_allclose(turn[[20, 40]], [left[0], right[0]])


def test_what_the_camera_does_not_see_gives_no_points():
    # A wall beside a floor, seen from above; the camera stands behind the wall.
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    wall = np.array([[0.0, -1, 0], [0, 1, 0], [0, 1, 1], [0, -1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    target = MeshTarget(MeshSampler(Mesh(np.concatenate([square, wall]), faces)))
    eye, axes = np.array([0.0, 0.0, 3.0]), np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
    raster = rasters.Pinhole(eye, axes)
    window = rasters.Window(np.array([-0.1, -0.1]), np.array([0.1, 0.1]))
    errors, rng = RangeErrors(3.0, grazing=0.0), np.random.default_rng(0)
    camera = Camera(np.array([6.0, 0, 0]), 1, 0.0)
    scan = rasters.read_raster("stripe", target, raster, window, rasters.Sampling(2000, 1.0), errors, rng, camera)
    middle = -target.center[0] / target.size  # of the wall, in the frame of the target
    floor = np.abs(scan.normals[:, 2]) > 0.5
    assert (scan.points[floor, 0] > middle).all() and floor.sum() > 500
