"""What the method "global" makes of shapes whose outside is hard to find."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
from solids import box, drilled_block, joined, ring, scrambled, sphere

from jetnormal.geometry.metrics import oriented_accuracy
from jetnormal.orientation.methods import choose_signs


def outward_share(points, normals):
    return oriented_accuracy(choose_signs(points, scrambled(normals)).normals, normals)[0]


def terrain(rng):
    """Hills with houses and trees, as an airborne scanner sees them: no floors, and no undersides of crowns."""
    ground = rng.uniform(0, 10, (20_000, 3))
    x, y, _ = ground.T
    ground[:, 2] = np.sin(x) * np.cos(y) / 2
    slope = np.stack([-np.cos(x) * np.cos(y) / 2, np.sin(x) * np.sin(y) / 2, np.ones(len(x))], axis=1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    parts = [(ground, slope)]
    for corner in ((2, 3), (6, 6), (7, 1.5)):
        points, normals = box(rng, 200, (*corner, -0.5), (corner[0] + 1.2, corner[1] + 0.8, 1.5))
        above = (points[:, 2] > np.sin(points[:, 0]) * np.cos(points[:, 1]) / 2) & (normals[:, 2] > -0.5)
        parts.append((points[above], normals[above]))
        under = ((ground[:, :2] > corner) & (ground[:, :2] < np.add(corner, (1.2, 0.8)))).all(axis=1)
        ground, slope = ground[~under], slope[~under]
    parts[0] = ground, slope
    for trunk in ((1, 8), (4.5, 5), (8.5, 8.5), (5, 1)):
        points, normals = sphere(rng, 900, 0.6, (*trunk, 1.3))
        parts.append((points[normals[:, 2] > -0.3], normals[normals[:, 2] > -0.3]))
    points, normals = joined(parts)
    return points + rng.normal(scale=0.02, size=points.shape), normals, len(ground)


def test_shells_look_out_of_the_matter_between_them():
    rng = np.random.default_rng(0)
    radii = np.repeat([1.0, 0.6, 0.3], [6000, 2500, 1000])
    directions = sphere(rng, len(radii))[1]
    outward = directions * np.where(radii == 0.6, -1, 1)[:, None]
    assert outward_share(directions * radii[:, None], outward) == 1


def test_a_ball_in_a_bottle_is_no_cavity():
    rng = np.random.default_rng(1)
    outside, inside = sphere(rng, 12_000), sphere(rng, 10_000, 0.9)
    for points, _ in (outside, inside):
        points[np.linalg.norm(points[:, :2], axis=1) < 0.15, 2] *= -1  # all at the bottom: leaves a neck open
    rim = ring(rng, 800, 0.22, 0.05)
    ball = sphere(rng, 3000, 0.4)
    parts = [outside, (inside[0], -inside[1]), ball]
    parts = [(p[keep], n[keep]) for p, n in parts for keep in [np.hypot(p[:, 0], p[:, 1]) > 0.2 * (p[:, 2] > 0.5)]]
    upper = rim[0][:, 2] > -2
    points, normals = joined([*parts, ((rim[0] + [0, 0, 0.93])[upper], rim[1][upper])])
    oriented = choose_signs(points, scrambled(normals)).normals
    count = len(parts[0][0]) + len(parts[1][0])
    own = slice(count, count + len(parts[2][0]))
    assert oriented_accuracy(oriented[own], normals[own])[0] == 1


def test_a_drilled_block_is_turned_outward_to_the_bottoms_of_its_holes():
    points, normals = drilled_block(np.random.default_rng(2), 5000)
    assert outward_share(points, normals) >= 0.998


def test_linked_rings_stay_apart():
    rng = np.random.default_rng(3)
    points, normals = ring(rng, 8000)
    other, across = ring(rng, 8000)
    other, across = other[:, [0, 2, 1]] + [1, 0, 0], across[:, [0, 2, 1]]
    assert outward_share(np.concatenate([points, other]), np.concatenate([normals, across])) == 1


def test_twenty_components_are_all_turned_outward():
    rng = np.random.default_rng(4)
    places = np.stack(np.meshgrid(range(5), range(2), range(2), indexing="ij"), -1).reshape(-1, 3) * 1.2
    parts = [
        box(rng, 400, place - 0.3, place + 0.3) if i % 2 else sphere(rng, 800, 0.45, place)
        for i, place in enumerate(places)
    ]
    assert outward_share(*joined(parts)) == 1


def test_an_open_hemisphere_is_told_apart_and_a_viewpoint_settles_it():
    points, normals = sphere(np.random.default_rng(5), 8000)
    points, normals = points[points[:, 0] > 0], normals[points[:, 0] > 0]
    result = choose_signs(points, scrambled(normals))
    assert result.open.all()
    assert oriented_accuracy(result.normals, normals)[1] == 1
    inside = choose_signs(points, scrambled(normals), "viewpoint", viewpoint=(0.2, 0.0, 0.0)).normals
    assert oriented_accuracy(inside, -normals)[0] == 1
    whole = choose_signs(*sphere(np.random.default_rng(5), 8000))
    assert not whole.open.any()


def test_uneven_density_and_outliers_are_withstood():
    rng = np.random.default_rng(6)
    points, normals = ring(rng, 40_000)
    keep = rng.uniform(size=len(points)) < np.geomspace(0.05, 1, 100)[((points[:, 0] / 1.26 + 1) * 49.9).astype(int)]
    points, normals = points[keep], normals[keep]
    count = len(points) // 50
    outliers, directions = rng.uniform(-1.5, 1.5, (count, 3)), sphere(rng, count)[1]
    oriented = choose_signs(
        np.append(points, outliers, axis=0), scrambled(np.append(normals, directions, axis=0))
    ).normals
    assert oriented_accuracy(oriented[: len(points)], normals)[0] >= 0.995


def test_a_terrain_looks_up_and_its_houses_and_trees_outward():
    points, normals, ground = terrain(np.random.default_rng(7))
    result = choose_signs(points, scrambled(normals))
    assert result.open[:ground].mean() > 0.99
    assert (result.normals[:ground, 2] > 0).mean() > 0.999
    assert oriented_accuracy(result.normals, normals)[0] > 0.98


def test_confidence_is_lower_where_the_sign_is_wrong():
    rng = np.random.default_rng(8)
    points, normals = joined([box(rng, 4000, (0, 0, 0), (1, 1, 0.06)), sphere(rng, 4000, 0.4, (0.5, 0.5, 1))])
    points += rng.normal(scale=0.015, size=points.shape)
    result = choose_signs(points, scrambled(normals))
    right = (result.normals * normals).sum(axis=1) > 0
    assert 0.005 < (~right).mean() < 0.3
    assert result.confidence[right].mean() > result.confidence[~right].mean() + 0.02
    assert (result.confidence >= 0.5).all() and (result.confidence <= 1).all()


CHILD = """
import numpy as np
import pytest
from jetnormal.orientation.methods import choose_signs
normals = np.random.default_rng(0).normal(size=(30_000, 3))
normals /= np.linalg.norm(normals, axis=1, keepdims=True)
points = normals + np.random.default_rng(1).normal(scale=0.02, size=normals.shape)
result = choose_signs(points, normals)
import hashlib
print(hashlib.sha256(result.normals.tobytes() + result.confidence.tobytes()).hexdigest())
"""


def test_the_number_of_threads_does_not_matter():
    digests = {
        subprocess.run(
            [sys.executable, "-c", CHILD],
            env=os.environ | {"OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "3")
    }
    assert len(digests) == 1 and len(digests.pop().strip()) == hashlib.sha256().digest_size * 2


@pytest.mark.parametrize("method", ["global", "mst"])
@pytest.mark.parametrize("distance", [1.5, 30.0, 1e5, 2e6])
def test_stray_points_change_nothing_wherever_they_are(method, distance):
    rng = np.random.default_rng(9)
    points, normals = sphere(rng, 2000)
    away, directions = sphere(rng, 20, distance)
    for strays in (away[:1], away, away * rng.uniform(0.5, 1, (20, 1))):
        count = len(strays)
        both = np.concatenate([points, strays]), scrambled(np.concatenate([normals, directions[:count]]))
        result = choose_signs(*both, method)
        assert oriented_accuracy(result.normals[:2000], normals)[0] == 1
        assert not result.open[:2000].any() and result.confidence[:2000].mean() > 0.85


def test_points_off_a_surface_take_its_sign():
    """Above and below a sphere, as outliers of photogrammetry are: no second side of a plate."""
    rng = np.random.default_rng(13)
    points, normals = sphere(rng, 5000)
    directions = sphere(rng, 100)[1]
    off = directions * (1 + rng.choice([-1, 1], (100, 1)) * rng.uniform(0.15, 0.3, (100, 1)))
    oriented = choose_signs(np.append(points, off, axis=0), scrambled(np.append(normals, directions, axis=0))).normals
    assert oriented_accuracy(oriented, np.append(normals, directions, axis=0))[0] == 1


@pytest.mark.parametrize("distance", [2.5, 100.0, 1e6])
def test_objects_have_the_signs_that_each_has_alone(distance):
    rng = np.random.default_rng(10)
    places = distance * np.stack(np.meshgrid(range(5), range(3), range(2)), axis=-1).reshape(-1, 3)
    parts = [sphere(rng, 300, 10.0 ** rng.uniform(-1, 0), place) for place in places]
    assert outward_share(*joined(parts)) == 1


def test_a_surface_in_pieces_is_one_object():
    rng = np.random.default_rng(11)
    faces = [(axis, side) for axis in range(3) for side in (-1, 1)]
    parts = []
    for axis, side in faces:  # six squares that do not touch: each alone is open
        points = rng.uniform(-0.8, 0.8, (900, 3))
        points[:, axis] = side
        parts.append((points, np.tile(side * np.eye(3)[axis], (900, 1))))
    points, normals = joined(parts)
    result = choose_signs(points, scrambled(normals))
    assert oriented_accuracy(result.normals, normals)[0] == 1 and not result.open.any()


def test_where_half_the_outside_is_missing_the_edge_between_both_sides_decides():
    """Most of a cup's inside is seen from outside, where the wall in front of it is missing."""
    rng = np.random.default_rng(12)
    angle, height = rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(-1, 1, 20_000)
    spoke = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    outer = rng.uniform(size=len(angle)) < 0.5
    points = spoke * np.where(outer, 1.0, 0.9)[:, None] + height[:, None] * [0, 0, 1]
    normals = np.where(outer[:, None], spoke, -spoke)
    seen = ~outer | (np.abs(angle - np.pi) < 0.5 * np.pi)
    rim = ring(rng, 6000, 0.95, 0.05)
    upper = rim[1][:, 2] > 0
    points, normals = joined([(points[seen], normals[seen]), (rim[0][upper] + [0, 0, 1], rim[1][upper])])
    assert outward_share(points, normals) > 0.995
