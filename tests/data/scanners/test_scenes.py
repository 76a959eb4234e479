"""Scanners inside procedural scenes."""

import numpy as np
import pytest

from jetnormal.data.scanners.draw import scan
from jetnormal.data.scanners.scenes import SCENE_SCANNERS, SceneTarget
from jetnormal.data.scenes.draw import SCENES, random_scene
from jetnormal.data.scenes.layout import Scene
from jetnormal.data.scenes.surfaces import box, joined, leaves

CASES = [(scene, kind) for scene in SCENE_SCANNERS for kind in SCENE_SCANNERS[scene]]


@pytest.fixture(scope="module")
def targets() -> dict[str, SceneTarget]:
    return {kind: SceneTarget(random_scene(np.random.default_rng(3), kind)) for kind in SCENES}


@pytest.mark.parametrize("kind", SCENES)
def test_scenes_have_sound_normals(kind):
    scene = random_scene(np.random.default_rng(1), kind)
    assert np.isfinite(scene.surface.vertices).all()
    length = np.linalg.norm(scene.surface.normals, axis=1)
    assert (np.isclose(length, 1) | (length == 0)).all()
    assert (length > 0).mean() > 0.5
    again = random_scene(np.random.default_rng(1), kind)
    np.testing.assert_array_equal(scene.surface.vertices, again.surface.vertices)


@pytest.mark.parametrize(("scene", "kind"), CASES)
def test_scans_of_scenes(targets, scene, kind):
    target = targets[scene]
    seen = scan(target, kind, 5000, np.random.default_rng(0))
    assert seen.kind == kind or (kind, seen.kind) == ("depth", "fused")
    np.testing.assert_allclose(np.linalg.norm(seen.normals, axis=1), 1, atol=1e-12)
    facing = ((seen.sensors - seen.points) * seen.normals).sum(1) > 0
    assert facing[seen.labeled].mean() > 0.98
    span = np.ptp(target.sample(1000, np.random.default_rng(0))[0], axis=0).max() * target.size
    assert np.ptp(seen.points[seen.labeled], axis=0).max() < 2 * span


def test_a_station_in_a_box_sees_six_planes_and_no_normals_of_leaves():
    walls = box([4.0, 6.0, 3.0])
    shrub = leaves(40, 0.2, [0.3, 0.3, 0.3], np.random.default_rng(0)).placed([1.2, 1.2, 1.0])
    middle = np.array([[-0.3, 0.2, 1.4]])
    target = SceneTarget(Scene("room", joined([walls, shrub]), middle, np.repeat(middle, 2, axis=0)))
    seen = scan(target, "station", 4000, np.random.default_rng(4))
    known = seen.labeled & (np.abs(seen.points).max(1) < 10)
    inside = np.minimum(np.minimum(2 - np.abs(seen.points[:, 0]), 3 - np.abs(seen.points[:, 1])),
                        1.5 - np.abs(seen.points[:, 2] - 1.5))  # fmt: skip
    assert np.sqrt(np.mean(inside[known] ** 2)) < 0.1
    np.testing.assert_allclose(np.abs(seen.normals[known]).max(1), 1, atol=1e-9)
    assert len(np.unique(seen.normals[known].round(3), axis=0)) >= 5
    near_shrub = np.linalg.norm(seen.points - [1.2, 1.2, 1.0], axis=1) < 0.45
    assert near_shrub.any() and not seen.labeled[near_shrub].any()
