"""A sphere as cloud and as mesh: what is seen must be that sphere."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import even_sphere

from jetnormal import Cloud, Mesh
from jetnormal.rendering.camera import Camera, make_camera
from jetnormal.rendering.light import develop
from jetnormal.rendering.scene import cloud_scene, mesh_scene
from jetnormal.rendering.surfels import see
from jetnormal.support.open3d_loader import import_open3d

needs_open3d = pytest.mark.skipif(import_open3d() is None, reason="Open3D cannot be loaded")


def sphere_cloud(count: int = 4000) -> Cloud:
    points = even_sphere(count)
    return Cloud(points, points)


def sphere_mesh() -> Mesh:
    from scipy.spatial import ConvexHull

    points = even_sphere(2000)
    faces = ConvexHull(points).simplices.astype(np.int64)
    inward = np.einsum("fd,fd->f", Mesh(points, faces).area_vectors(), points[faces[:, 0]]) < 0
    faces[inward] = faces[inward, ::-1]
    return Mesh(points, faces)


def front(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Where the rays meet the unit sphere first, (H, W, 3), NaN beside it, and how far it is off the rim."""
    rays = camera.rays()
    start = np.array([0, 0, camera.distance])
    a, b = (rays**2).sum(axis=2), rays @ start
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - a * (start @ start - 1))
    place = start + rays * ((-b - root) / a)[..., None]
    return place, place[..., 2]


@pytest.mark.parametrize("subject", ["cloud", pytest.param("mesh", marks=needs_open3d)])
def test_a_sphere_is_seen_where_it_is_without_holes(subject):
    scene = cloud_scene(sphere_cloud()) if subject == "cloud" else mesh_scene(sphere_mesh())
    camera = make_camera(scene.points, np.array([1.0, -1, 0.5]), 160)
    surfels = see(scene, camera)
    place, height = front(camera)
    clear, nothing = height > 0.5, np.isnan(height)  # of the rim
    assert np.isfinite(surfels.depth[clear]).all()
    assert np.abs(surfels.depth - (camera.distance - place[..., 2]))[clear].max() < 0.02
    assert ((surfels.normals * place).sum(axis=2)[clear] > 0.98).all()
    assert not surfels.back[clear].any()
    shown = scene.points if scene.faces is None else scene.points[scene.faces].mean(axis=1)
    near = camera.to_frame(shown)[surfels.index[clear]]
    assert np.linalg.norm(near - place[clear], axis=1).max() < 0.12
    assert np.array_equal(surfels.index >= 0, np.isfinite(surfels.depth))
    assert np.isfinite(surfels.depth[nothing]).mean() < 0.08  # disks reach a little beyond the rim


def test_a_normal_that_points_away_shows_its_back():
    cloud = sphere_cloud()
    camera = make_camera(cloud.points, np.array([0.0, -1, 0]), 80)
    _, height = front(camera)
    assert see(cloud_scene(Cloud(cloud.points, -cloud.points)), camera).back[height > 0.5].all()


@needs_open3d
def test_a_mesh_seen_from_inside_shows_its_back():
    mesh = sphere_mesh()
    inverted = mesh_scene(Mesh(mesh.vertices, mesh.faces[:, ::-1]))
    camera = make_camera(mesh.vertices, np.array([0.0, -1, 0]), 80)
    assert see(inverted, camera).back[front(camera)[1] > 0.3].all()


def test_the_front_hides_what_is_behind():
    cloud = sphere_cloud()
    red = np.where(cloud.points[:, 1] < 0, 255, 0).astype(np.uint8)
    colored = Cloud(cloud.points, cloud.normals, {"red": red, "green": 255 - red, "blue": 0 * red})
    camera = make_camera(cloud.points, np.array([0.0, -1, 0]), 80)
    surfels = see(cloud_scene(colored, "file"), camera)
    assert (surfels.colors[front(camera)[1] > 0.3] > [0.99, -1, -1]).all()


def test_sparse_and_single_points_are_drawn():
    for points in (np.zeros((1, 3)), np.eye(3)):
        scene = cloud_scene(Cloud(points))
        camera = make_camera(scene.points, np.array([0.5, -1, 0.5]), 64)
        assert np.isfinite(see(scene, camera).depth).sum() >= len(points)


def test_light_comes_from_above_and_the_ground_is_white():
    scene = cloud_scene(sphere_cloud(), "plain")
    camera = make_camera(scene.points, np.array([0.0, -1, 0]), 120)
    picture = develop(see(scene, camera), camera, scene.radius, 2, "white")
    assert picture.shape == (60, 60, 3)
    assert (picture[0, 0] == 255).all()
    assert picture[15, 25].mean() > picture[45, 35].mean() + 30
    dark = develop(see(scene, camera), camera, scene.radius, 2, "dark")
    assert dark[0, 0].max() < 40 and np.array_equal(dark[30, 30], picture[30, 30])


def test_a_cloud_without_normals_gets_its_shape_from_its_depth():
    scene = cloud_scene(Cloud(sphere_cloud().points))
    camera = make_camera(scene.points, np.array([0.0, -1, 0]), 120)
    picture = develop(see(scene, camera), camera, scene.radius, 2, "white").astype(int)
    assert picture[15, 25].mean() > picture[45, 35].mean() + 30


def test_sharp_edges_stay_sharp():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = np.array([[0, 4, 5], [0, 5, 1], [0, 1, 3], [0, 3, 2]])  # y = 0 and x = 0, which meet at a right angle
    scene = mesh_scene(Mesh(corners, faces))
    first, second = scene.normals[scene.faces[:2]], scene.normals[scene.faces[2:]]
    assert np.allclose(first, [0, -1, 0]) and np.allclose(second, [-1, 0, 0])


def test_a_rough_surface_is_shaded_smoothly():
    rng = np.random.default_rng(0)
    axis = np.arange(30.0)
    x, y = (values.ravel() for values in np.meshgrid(axis, axis))
    corner = (np.arange(29)[:, None] * 30 + np.arange(29)).reshape(-1, 1)
    faces = np.concatenate([np.add(corner, [0, 1, 30]), np.add(corner, [1, 31, 30])])
    smooth, rough = (Mesh(np.stack([x, y, s * rng.normal(size=900)], axis=1), faces) for s in (0.01, 0.5))
    assert len(mesh_scene(smooth).points) == len(mesh_scene(rough).points) == 900
