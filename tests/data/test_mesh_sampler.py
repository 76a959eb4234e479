from __future__ import annotations

import struct
import time

import numpy as np
import pytest

from jetnormal.data.mesh_sampler import Mesh, MeshSampler, load_mesh
from jetnormal.errors import InputError

CUBE_VERTICES = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_FACES = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def cylinder(sides: int) -> Mesh:
    """Radius 1, from z = 0 to z = 2, closed."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(sides)], axis=1)
    vertices = np.concatenate([ring, ring + np.array([0, 0, 2]), [[0, 0, 0], [0, 0, 2]]])
    a, b = np.arange(sides), (np.arange(sides) + 1) % sides
    bottom, top = np.full(sides, 2 * sides), np.full(sides, 2 * sides + 1)
    faces = [(a, b, b + sides), (a, b + sides, a + sides), (bottom, b, a), (top, a + sides, b + sides)]
    return Mesh(vertices, np.concatenate([np.stack(face, axis=1) for face in faces]))


def sphere(subdivisions: int = 4) -> Mesh:
    """A unit sphere: an octahedron whose triangles are split into four, again and again."""
    vertices = [tuple(v) for v in np.concatenate([np.eye(3), -np.eye(3)])]
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    for _ in range(subdivisions):
        middles: dict[tuple[int, int], int] = {}
        split = []
        for face in faces:
            ends = [tuple(sorted((face[i], face[(i + 1) % 3]))) for i in range(3)]
            for a, b in ends:
                if (a, b) not in middles:
                    middle = np.add(vertices[a], vertices[b])
                    middles[a, b] = len(vertices)
                    vertices.append(tuple(middle / np.linalg.norm(middle)))
            x, y, z = (middles[end] for end in ends)
            split += [(face[0], x, z), (face[1], y, x), (face[2], z, y), (x, y, z)]
        faces = split
    return Mesh(np.array(vertices), np.array(faces))


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(1), -1, 1)))


def test_cube_keeps_exact_face_normals_up_to_its_edges():
    points, normals = MeshSampler(Mesh(CUBE_VERTICES, CUBE_FACES)).sample(20_000, np.random.default_rng(0))
    axis = np.argmin(np.minimum(np.abs(points), np.abs(points - 1)), axis=1)
    expected = np.zeros_like(points)
    expected[np.arange(len(points)), axis] = np.sign(points[np.arange(len(points)), axis] - 0.5)
    np.testing.assert_allclose(normals, expected, atol=1e-12)


def test_every_face_gets_its_share_of_the_points():
    mesh = Mesh(CUBE_VERTICES * [1, 2, 3], CUBE_FACES)
    sampler = MeshSampler(mesh)
    assert sampler.area == pytest.approx(22)
    _, normals = sampler.sample(40_000, np.random.default_rng(1))
    share = np.abs(normals).mean(axis=0)
    np.testing.assert_allclose(share, np.array([12, 6, 4]) / 22, atol=0.01)


def test_points_are_uniform_inside_a_triangle():
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    points, _ = MeshSampler(mesh).sample(40_000, np.random.default_rng(0))
    np.testing.assert_allclose(points.mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.005)
    near_corner = (points.sum(axis=1) < 0.5).mean()  # a quarter of the area
    assert near_corner == pytest.approx(0.25, abs=0.01)


def test_smooth_surface_is_interpolated():
    points, normals = MeshSampler(sphere()).sample(20_000, np.random.default_rng(0))
    radial = points / np.linalg.norm(points, axis=1, keepdims=True)
    assert angles(normals, radial).max() < 1.0  # flat faces would be off by more than 2 degrees


def test_rim_of_a_cylinder_is_sharp_and_its_wall_smooth():
    points, normals = MeshSampler(cylinder(24)).sample(20_000, np.random.default_rng(0))
    caps = (points[:, 2] == 0) | (points[:, 2] == 2)
    np.testing.assert_allclose(
        normals[caps], np.stack([0 * points[caps, 2]] * 2 + [points[caps, 2] - 1], axis=1), atol=1e-9
    )
    wall = points[~caps] * [1, 1, 0]
    assert angles(normals[~caps], wall / np.linalg.norm(wall, axis=1, keepdims=True)).max() < 0.5


def test_coarse_cylinder_has_sharp_sides():
    """Eight sides turn by 45 degrees, more than the 35 at which corners are sharp."""
    points, normals = MeshSampler(cylinder(8)).sample(5_000, np.random.default_rng(0))
    wall = (points[:, 2] > 0) & (points[:, 2] < 2)
    sector = np.degrees(np.arctan2(normals[wall, 1], normals[wall, 0])) - 22.5
    np.testing.assert_allclose(sector / 45, np.round(sector / 45), atol=1e-9)


def test_closed_mesh_wound_inwards_is_turned_around():
    points, normals = MeshSampler(Mesh(CUBE_VERTICES + 100, CUBE_FACES[:, ::-1])).sample(
        2_000, np.random.default_rng(0)
    )
    assert (((points - 100.5) * normals).sum(axis=1) > 0.49).all()


def test_open_mesh_keeps_its_winding():
    triangle = np.array([[0.0, 0, 5], [1, 0, 5], [0, 1, 5]])
    for faces, expected in (([[0, 1, 2]], 1.0), ([[0, 2, 1]], -1.0)):
        _, normals = MeshSampler(Mesh(triangle, np.array(faces))).sample(10, np.random.default_rng(0))
        np.testing.assert_array_equal(normals[:, 2], expected)


def test_degenerate_faces_are_neither_sampled_nor_felt():
    slivers = np.array([[0, 0, 1], [3, 3, 3], [0, 1, 1]])
    mesh = Mesh(CUBE_VERTICES, np.concatenate([slivers, CUBE_FACES, slivers]))
    points, normals = MeshSampler(mesh).sample(20_000, np.random.default_rng(0))
    reference = MeshSampler(Mesh(CUBE_VERTICES, CUBE_FACES)).sample(20_000, np.random.default_rng(0))
    np.testing.assert_array_equal(points, reference[0])
    np.testing.assert_array_equal(normals, reference[1])


def test_sampling_is_fast_and_repeatable():
    sampler = MeshSampler(sphere())
    first = sampler.sample(1_000, np.random.default_rng(3))
    again = sampler.sample(1_000, np.random.default_rng(3))
    np.testing.assert_array_equal(first, again)
    start = time.perf_counter()
    sampler.sample(100_000, np.random.default_rng(0))
    assert time.perf_counter() - start < 1.0


def write_text(path, text):
    path.write_text(text)
    return path


def write_off(path):
    rows = ["OFF", "8 12 0", *(" ".join(map(str, v)) for v in CUBE_VERTICES)]
    return write_text(path, "\n".join([*rows, *("3 " + " ".join(map(str, f)) for f in CUBE_FACES)]) + "\n")


def write_obj(path):
    rows = ["v " + " ".join(map(str, v)) for v in CUBE_VERTICES]
    return write_text(path, "\n".join([*rows, *("f " + " ".join(map(str, f + 1)) for f in CUBE_FACES)]) + "\n")


def write_ply(path):
    header = "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n"
    header += "element face 12\nproperty list uchar int vertex_indices\nend_header"
    rows = [header, *(" ".join(map(str, v)) for v in CUBE_VERTICES)]
    return write_text(path, "\n".join([*rows, *("3 " + " ".join(map(str, f)) for f in CUBE_FACES)]) + "\n")


def write_stl(path):
    triangles = CUBE_VERTICES[CUBE_FACES]
    packed = b"".join(struct.pack("<12fH", 0, 0, 0, *triangle.reshape(-1), 0) for triangle in triangles)
    path.write_bytes(bytes(80) + struct.pack("<I", len(triangles)) + packed)
    return path


def write_npz(path):
    np.savez(path, vertices=CUBE_VERTICES.astype(np.float32), faces=CUBE_FACES.astype(np.int32))
    return path


@pytest.mark.parametrize("writer", [write_npz, write_off, write_obj, write_ply, write_stl])
def test_all_formats_give_the_same_cube(writer, tmp_path):
    path = writer(tmp_path / f"cube.{writer.__name__.removeprefix('write_')}")
    mesh = load_mesh(path)
    assert mesh.vertices.shape == (8, 3)  # STL's 36 corners are merged
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64
    sampler = MeshSampler(mesh)
    assert sampler.area == pytest.approx(6)
    points, normals = sampler.sample(500, np.random.default_rng(0))
    np.testing.assert_allclose(((points - 0.5) * normals).sum(axis=1), 0.5)


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (CUBE_VERTICES, np.empty((0, 3), int), "holds no triangles"),
        (CUBE_VERTICES, np.array([[0, 1, 2, 3]]), "holds no triangles"),
        (CUBE_VERTICES[:, :2], CUBE_FACES, "holds no triangles"),
        (CUBE_VERTICES[:5], CUBE_FACES, "does not exist"),
        (CUBE_VERTICES, CUBE_FACES - 1, "does not exist"),
        (np.where(CUBE_VERTICES == 1, np.nan, 0), CUBE_FACES, "not finite"),
        (CUBE_VERTICES * [1, 0, 0], CUBE_FACES, "degenerate"),
    ],
)
def test_unusable_arrays_are_refused(vertices, faces, message, tmp_path):
    path = tmp_path / "bad.npz"
    np.savez(path, vertices=vertices, faces=faces)
    with pytest.raises(InputError, match=message) as caught:
        load_mesh(path)
    assert str(path) in str(caught.value)


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        load_mesh(tmp_path / "absent.npz")
    with pytest.raises(InputError, match="not a mesh format"):
        load_mesh(write_text(tmp_path / "mesh.txt", "v 0 0 0"))
    with pytest.raises(InputError, match="not a readable"):
        load_mesh(write_text(tmp_path / "mesh.npz", "not a zip archive"))
    np.savez(tmp_path / "points.npz", points=CUBE_VERTICES)
    with pytest.raises(InputError, match="lacks the array 'vertices'"):
        load_mesh(tmp_path / "points.npz")


def test_file_without_faces_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no triangles"):
        load_mesh(write_text(tmp_path / "cloud.obj", "v 0 0 0\nv 1 0 0\n"))
    with pytest.raises(InputError, match="not valid in a PLY header"):
        load_mesh(write_text(tmp_path / "broken.ply", "ply\nnonsense\n"))
