"""Meshes written here and read back, by Open3D or by hand where its reader has single precision."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from jetnormal.errors import InputError
from jetnormal.formats.meshes import check_mesh_target, read_mesh, write_mesh
from jetnormal.mesh import Mesh

UTM = np.array([456_789.0, 5_432_109.0, 321.0])
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
COLORS = np.array([[1, 0, 0], [0, 1, 0], [0, 0.2, 1], [0.5, 0.6, 0.7]])


def tetrahedron(offset: np.ndarray | float = 0.0, colors: np.ndarray | None = None) -> Mesh:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    return Mesh(corners / 3 + offset, TETRAHEDRON, colors)


def by_corners(mesh: Mesh) -> np.ndarray:
    """Triangles in a canonical order: readers reorder faces and vertices."""
    triangles = np.round(mesh.vertices, 4)[mesh.faces].reshape(-1, 9)
    return triangles[np.lexsort(triangles.T)]


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off", "glb"])
@pytest.mark.parametrize("colors", [None, COLORS])
def test_a_mesh_comes_back(tmp_path, suffix, colors):
    path = tmp_path / f"mesh.{suffix}"
    warnings = write_mesh(tetrahedron(colors=colors), path)
    back = read_mesh(path)
    assert back.faces.shape == (4, 3)
    corners = back.vertices[back.faces]
    assert np.allclose(np.cross(*np.diff(corners, axis=1).swapaxes(0, 1)).sum(axis=0), 0, atol=1e-6)  # closed
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(1 / 162)  # and wound outwards
    if colors is not None and suffix != "stl":
        nearest = np.abs(back.vertices[:, None] - tetrahedron().vertices).sum(axis=2).argmin(axis=1)
        assert np.allclose(back.colors, colors[nearest], atol=0.005)
    assert any("no colors" in warning for warning in warnings) == (suffix == "stl" and colors is not None)


def test_ply_keeps_every_bit_of_large_coordinates(tmp_path):
    mesh = tetrahedron(UTM)
    write_mesh(mesh, tmp_path / "mesh.ply")
    assert np.array_equal(read_mesh(tmp_path / "mesh.ply").vertices, mesh.vertices)


@pytest.mark.parametrize(("suffix", "prefix"), [("obj", "v "), ("off", "")])
def test_text_formats_keep_nanometers_of_large_coordinates(tmp_path, suffix, prefix):
    path = tmp_path / f"mesh.{suffix}"
    write_mesh(tetrahedron(UTM), path)
    lines = path.read_text().splitlines()[0 if suffix == "obj" else 2 :][:4]
    vertices = np.array([[float(word) for word in line.removeprefix(prefix).split()] for line in lines])
    assert np.abs(vertices - tetrahedron(UTM).vertices).max() < 2e-9


def glb(path: Path) -> tuple[dict, np.ndarray]:
    """The JSON of a .glb file of a tetrahedron and its positions as they stand there."""
    content = path.read_bytes()
    assert content[:4] == b"glTF" and int.from_bytes(content[8:12], "little") == len(content)
    length = int.from_bytes(content[12:16], "little")
    return json.loads(content[20 : 20 + length]), np.frombuffer(content, "<f4", 12, 28 + length).reshape(4, 3)


def test_in_glb_y_is_up_and_it_comes_back_as_z(tmp_path):
    write_mesh(tetrahedron([1.0, 2, 3]), tmp_path / "mesh.glb")
    document, vertices = glb(tmp_path / "mesh.glb")
    placed = vertices + document["nodes"][0]["translation"]
    assert np.allclose(placed[3] - placed[0], [0, 1 / 3, 0]) and np.allclose(placed[0], [1, 3, -2])
    assert "extras" not in document["asset"]
    assert np.allclose(by_corners(read_mesh(tmp_path / "mesh.glb")), by_corners(tetrahedron([1.0, 2, 3])), atol=1e-4)


def test_glb_takes_large_coordinates_off_and_says_so(tmp_path):
    path = tmp_path / "mesh.glb"
    (warning,) = write_mesh(tetrahedron(UTM), path)
    assert "[456789.0, 5432109.0, 321.0]" in warning and "extras" in warning
    document, vertices = glb(path)
    assert document["asset"]["extras"] == {"jetnormal_offset": [456789.0, 5432109.0, 321.0]}
    assert np.abs(document["nodes"][0]["translation"]).max() < 1
    assert np.allclose(np.ptp(vertices, axis=0), 1 / 3, rtol=1e-6)
    assert np.abs(read_mesh(path).vertices.min(axis=0) - UTM).max() < 1e-6


def test_stl_warns_of_lost_precision(tmp_path):
    assert write_mesh(tetrahedron(), tmp_path / "near.stl") == []
    (warning,) = write_mesh(tetrahedron(UTM), tmp_path / "far.stl")
    assert "single precision" in warning and "far.stl" in warning


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("suffix", [".stl", ".glb"])
def test_what_single_precision_cannot_hold_is_refused(tmp_path, suffix):
    mesh = Mesh(np.eye(3) * 1e40, np.array([[0, 1, 2]]))
    with pytest.raises(InputError, match=r"as large as 1e\+40 do not fit"):
        write_mesh(mesh, tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_vertex_normals_point_outward():
    mesh = tetrahedron()
    normals = mesh.vertex_normals()
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert ((mesh.vertices - mesh.vertices.mean(axis=0)) * normals).sum(axis=1).min() > 0.1


@pytest.mark.parametrize("name", ["mesh.xyz", "mesh", "nowhere/mesh.ply"])
def test_a_target_that_cannot_be_written_is_an_input_error(tmp_path, name):
    for attempt in (lambda path: check_mesh_target(path), lambda path: write_mesh(tetrahedron(), path)):
        with pytest.raises(InputError, match="mesh"):
            attempt(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_replaced_only_when_asked(tmp_path):
    path = tmp_path / "mesh.obj"
    path.write_text("precious")
    with pytest.raises(InputError, match="`overwrite`"):
        write_mesh(tetrahedron(), path)
    assert path.read_text() == "precious"
    write_mesh(tetrahedron(), path, overwrite=True)
    assert path.read_text().startswith("v ")
