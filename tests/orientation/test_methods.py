from __future__ import annotations

import time

import numpy as np
import pytest

from jetnormal.geometry.metrics import oriented_accuracy
from jetnormal.orientation.calibration import probability
from jetnormal.orientation.methods import choose_signs

N = 5000


def sphere(rng, n=N):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals.copy(), normals


def torus(rng):
    around, across = rng.uniform(0, 2 * np.pi, (2, N))
    center = np.stack([np.cos(around), np.sin(around), np.zeros(N)], axis=1)
    normals = np.cos(across)[:, None] * center
    normals[:, 2] = np.sin(across)
    return center + 0.3 * normals, normals


def box(rng, size=(1.0, 1.0, 1.0), n=N):
    size = np.asarray(size)
    area = size.prod() / size
    axis, side, rows = rng.choice(3, n, p=area / area.sum()), rng.choice([-1.0, 1.0], n), np.arange(n)
    points, normals = rng.uniform(-0.5, 0.5, (n, 3)), np.zeros((n, 3))
    points[rows, axis], normals[rows, axis] = side / 2, side
    return points * size, normals


def thin_plate(rng):
    return box(rng, (1.0, 1.0, 0.03))


def cylinder(rng):
    angle, side = rng.uniform(0, 2 * np.pi, N), rng.choice([-1.0, 1.0], N)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(N)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    cap = rng.uniform(size=N) < 1 / 4  # radius 1, height 3
    radius = np.sqrt(rng.uniform(size=N))
    points = np.where(cap[:, None], radius[:, None] * out + 1.5 * side[:, None] * up, out)
    points[~cap, 2] = rng.uniform(-1.5, 1.5, (~cap).sum())
    return points, np.where(cap[:, None], side[:, None] * up, out)


def plane(rng):
    points = rng.uniform(size=(N, 3)) * [1, 1, 0]
    return points, np.tile([0.0, 0.0, 1.0], (N, 1))


def scrambled(normals, seed=7):
    return normals * np.random.default_rng(seed).choice([-1.0, 1.0], (len(normals), 1))


def outward_share(points, normals, method="global"):
    return oriented_accuracy(choose_signs(points, scrambled(normals), method).normals, normals)[0]


SHAPES = [sphere, torus, box, thin_plate, cylinder]
both_methods = pytest.mark.parametrize("method", ["global", "mst"])


@both_methods
@pytest.mark.parametrize("shape", SHAPES)
def test_solids_are_turned_outward(shape, method):
    points, normals = shape(np.random.default_rng(0))
    assert outward_share(points, normals, method) >= 0.999


@both_methods
@pytest.mark.parametrize("shape", [sphere, torus])
def test_noise_of_one_spacing_is_withstood(shape, method):
    rng = np.random.default_rng(1)
    points, normals = shape(rng)
    spacing = np.sqrt(4 * np.pi / N)
    assert outward_share(points + rng.normal(size=points.shape) * spacing, normals, method) >= 0.995


@both_methods
@pytest.mark.parametrize("shape", SHAPES)
def test_outliers_do_not_turn_a_solid_inside_out(shape, method):
    rng = np.random.default_rng(2)
    points, normals = shape(rng)
    outliers, directions = rng.uniform(-2, 2, (N // 50, 3)), sphere(rng, N // 50)[1]
    oriented = choose_signs(np.append(points, outliers, axis=0), np.append(normals, directions, axis=0), method).normals
    assert oriented_accuracy(oriented[:N], normals)[0] >= 0.99


@both_methods
def test_every_component_is_turned_outward(method):
    rng = np.random.default_rng(3)
    parts = [sphere(rng, 60) for _ in range(500)]
    points = np.concatenate([part[0] + [10 * i, 0, 0] for i, part in enumerate(parts)])
    assert outward_share(points, np.concatenate([part[1] for part in parts]), method) >= 0.995


@both_methods
def test_a_plate_of_one_hundredth_has_two_sides(method):
    points, normals = box(np.random.default_rng(3), (1.0, 1.0, 0.01), 30_000)
    assert outward_share(points, normals, method) >= 0.999


@both_methods
def test_an_open_sheet_is_turned_up(method):
    rng = np.random.default_rng(4)
    points = rng.uniform(0, 10, (N, 3))
    x, y, _ = points.T
    points[:, 2] = np.sin(x) * np.sin(y) / 2
    normals = np.stack([-np.cos(x) * np.sin(y) / 2, -np.sin(x) * np.cos(y) / 2, np.ones(N)], axis=1)
    np.testing.assert_array_equal(choose_signs(points, scrambled(normals), method).normals, normals)


@both_methods
@pytest.mark.parametrize("shape", SHAPES)
def test_directions_are_the_same_bits_and_incoming_signs_do_not_matter(shape, method):
    points, normals = shape(np.random.default_rng(5))
    normals = normals * np.random.default_rng(6).uniform(0.1, 9, (N, 1))  # any length
    oriented = choose_signs(points, normals, method).normals
    np.testing.assert_array_equal(np.abs(oriented), np.abs(normals))
    same = np.all(oriented == normals, axis=1) | np.all(oriented == -normals, axis=1)
    assert same.all()
    np.testing.assert_array_equal(choose_signs(points, scrambled(normals), method).normals, oriented)


@both_methods
def test_order_and_offset_of_the_points_do_not_matter(method):
    points, normals = torus(np.random.default_rng(8))
    points += np.random.default_rng(8).normal(scale=0.01, size=points.shape)
    points = np.round(points * 2**20) / 2**20  # exact under the offset
    oriented = choose_signs(points, normals, method).normals
    order = np.random.default_rng(9).permutation(N)
    np.testing.assert_array_equal(
        choose_signs(points[order], scrambled(normals)[order], method).normals, oriented[order]
    )
    np.testing.assert_array_equal(
        choose_signs(points + np.array([5e5, 5e6, 300]), scrambled(normals), method).normals, oriented
    )


@pytest.mark.parametrize("method", ["global", "mst", "up", "viewpoint"])
def test_rows_without_point_or_direction_stay_and_take_no_part(method):
    points, normals = sphere(np.random.default_rng(10))
    viewpoint = (0.0, 0.0, 9.0) if method == "viewpoint" else None
    rows = np.arange(0, N, 7)
    whole = np.delete(np.arange(N), rows)
    broken = scrambled(normals)
    points[rows[0::4], 1], points[rows[1::4]] = np.nan, np.inf
    broken[rows[2::4]], broken[rows[3::4]] = np.nan, 0
    oriented = choose_signs(points, broken, method, viewpoint=viewpoint).normals
    np.testing.assert_array_equal(oriented[rows], broken[rows])
    alone = choose_signs(points[whole], normals[whole], method, viewpoint=viewpoint).normals
    np.testing.assert_array_equal(oriented[whole], alone)


def test_copies_of_points_are_oriented_with_their_surroundings():
    points, normals = sphere(np.random.default_rng(11), 500)
    assert outward_share(np.repeat(points, 30, axis=0), np.repeat(normals, 30, axis=0)) == 1


def test_many_coplanar_points_take_no_longer_than_others():
    rng = np.random.default_rng(12)
    side = np.arange(450.0)
    grid = np.stack(np.meshgrid(side, side, [5.0]), axis=-1).reshape(-1, 3)
    up = np.tile([0.0, 0.0, 1.0], (len(grid), 1))
    ball, normals = sphere(rng, len(grid))
    start = time.perf_counter()
    outward_share(ball, normals)
    middle = time.perf_counter()
    assert outward_share(grid, up) == 1
    assert time.perf_counter() - middle < 3 * (middle - start) + 1


@pytest.mark.parametrize("n", [0, 1, 2, 3])
@pytest.mark.parametrize("method", ["global", "mst", "up"])
def test_a_few_points_are_enough(n, method):
    oriented = choose_signs(np.eye(3)[:n], np.full((n, 3), -1.0), method).normals
    assert oriented.shape == (n, 3)
    assert (oriented == (oriented[:1] if n else 0)).all()


def test_viewpoint_turns_normals_to_the_scanner():
    rng = np.random.default_rng(13)
    points, normals = rng.normal((5e5, 5e6, 0), size=(N, 3)), sphere(rng)[1]
    viewpoint = (5e5 + 1, 5e6 - 2, 3.0)
    oriented = choose_signs(points, normals, "viewpoint", viewpoint=viewpoint).normals
    sights = viewpoint - points
    cosine = np.einsum("nd,nd->n", oriented, sights) / np.linalg.norm(sights, axis=1)
    assert (cosine[np.abs(cosine) > 0.25] > 0).all() and (cosine > 0).mean() > 0.9
    np.testing.assert_array_equal(np.abs(oriented), np.abs(normals))


def test_each_point_can_have_a_viewpoint_of_its_own():
    rng = np.random.default_rng(15)
    points, normals = rng.normal(size=(N, 3)), sphere(rng)[1]
    viewpoints = points + rng.normal(size=(N, 3))
    viewpoints[::10, 1] = np.nan
    result = choose_signs(points, scrambled(normals), "viewpoint", viewpoint=viewpoints)
    cosine = np.einsum("nd,nd->n", result.normals, viewpoints - points)
    known = np.isfinite(cosine)
    cosine /= np.linalg.norm(viewpoints - points, axis=1)
    clear = known & (np.abs(cosine) > 0.25)
    assert known.sum() == N * 9 // 10 and (cosine[clear] > 0).all()
    assert (result.normals[~known, 2] > 0).all() and (result.confidence[~known] == 0).all()
    expected = probability(np.abs(cosine[known]), "sight")
    np.testing.assert_allclose(result.confidence[known], expected, atol=1e-6)


def test_neighbors_settle_what_a_sight_line_grazes():
    rng = np.random.default_rng(16)
    points = np.column_stack([rng.uniform(-1, 1, (N, 2)), np.zeros(N)])
    tilted = np.column_stack([rng.normal(scale=0.15, size=(N, 2)), np.ones(N)])
    viewpoint = np.array([20.0, 0, 3.0])  # 8.5 degrees above the plane
    plain = np.einsum("nd,nd->n", tilted, viewpoint - points) > 0
    oriented = choose_signs(points, scrambled(tilted), "viewpoint", viewpoint=viewpoint).normals
    assert plain.mean() < 0.9 < 0.99 < (oriented[:, 2] > 0).mean()


def test_up_turns_normals_up_then_along_y_then_along_x():
    normals = np.array([[1, 1, -0.1], [0, -1, 0.2], [1, -1, 0], [-1, 0, 0], [1, 0, 0]], dtype=np.float32)
    oriented = choose_signs(np.zeros((5, 3)), normals, "up").normals
    assert oriented.dtype == np.float32
    np.testing.assert_array_equal(oriented, normals * np.array([[-1], [1], [-1], [-1], [1]]))


def test_none_returns_a_copy():
    normals = scrambled(sphere(np.random.default_rng(14))[1])
    oriented = choose_signs(normals, normals, "none").normals
    np.testing.assert_array_equal(oriented, normals)
    assert oriented is not normals


def test_unusable_arguments_are_refused():
    points = np.eye(3)
    with pytest.raises(ValueError, match="global, view, mst, viewpoint, up, terrain, inside, none"):
        choose_signs(points, points, "down")
    with pytest.raises(ValueError, match="viewpoint"):
        choose_signs(points, points, "viewpoint")
    with pytest.raises(ValueError, match="must both be"):
        choose_signs(points, points[:2])
