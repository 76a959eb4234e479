"""Meshes as other programs write them, and damaged ones."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from jetnormal.errors import InputError
from jetnormal.formats.mesh_readers import fans
from jetnormal.formats.meshes import read_mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]])
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 2
property list uchar int vertex_indices
end_header
0 0 0 255 0 51
1 0 0 255 0 51
1 1 0 255 0 51
0 1 0 255 0 51
"""


def written(tmp_path: Path, name: str, content: str | bytes) -> Path:
    path = tmp_path / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def gltf(count: int = 3, **changes) -> dict:
    """A triangle whose buffer lies in a file of its own, moved by a node."""
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [10, 0, 0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": 48, "uri": "corners.bin"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
    }
    return document | changes


@pytest.mark.parametrize(
    ("rows", "faces"),
    [
        ("3 0 1 2\n3 0 2 3\n", [[0, 1, 2], [0, 2, 3]]),
        ("4 0 1 2 3\n3 0 2 3\n", [[0, 1, 2], [0, 2, 3], [0, 2, 3]]),
        ("2 0 1\n3 0 2 3\n", [[0, 2, 3]]),
    ],
)
def test_polygons_of_ply_become_fans(tmp_path, rows, faces):
    mesh = read_mesh(written(tmp_path, "a.ply", PLY + rows))
    assert mesh.faces.tolist() == faces
    assert np.array_equal(mesh.vertices, SQUARE)
    assert np.allclose(mesh.colors, [1, 0, 0.2])


def test_fans_keep_the_order_of_the_polygons():
    assert fans([[0, 1, 2, 3], [4, 5, 6], [0, 1], [6, 7, 8, 9]]).tolist() == [
        [0, 1, 2], [0, 2, 3], [4, 5, 6], [6, 7, 8], [6, 8, 9],
    ]  # fmt: skip


def test_other_elements_may_stand_before_the_faces(tmp_path):
    text = PLY.replace("element face", "element edge 1\nproperty int a\nelement face") + "7\n3 0 1 2\n3 0 2 3\n"
    assert read_mesh(written(tmp_path, "a.ply", text)).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_obj_with_normals_quads_and_comments(tmp_path):
    text = "# made by hand\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1 4//1\n"
    mesh = read_mesh(written(tmp_path, "a.obj", text))
    assert np.allclose(mesh.area_vectors().sum(axis=0), [0, 0, 1])


@pytest.mark.parametrize("colors", [" 255 0 51 255", " 1.0 0 0.2 1"])
def test_off_with_comments_and_colors(tmp_path, colors):
    rows = "".join(f"{x} {y} {z}{colors}\n" for x, y, z in SQUARE)
    mesh = read_mesh(written(tmp_path, "a.off", f"COFF # square\n\n4 1 0\n{rows}4 0 1 2 3 0.5 0.5 0.5\n"))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert np.allclose(mesh.colors, [1, 0, 0.2])


def test_stl_of_both_kinds_shares_its_vertices(tmp_path):
    corners = SQUARE[[[0, 1, 2], [0, 2, 3]]]
    text = "".join(
        "facet normal 0 0 1\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in face)
        + "endloop\nendfacet\n"
        for face in corners
    )
    mesh = read_mesh(written(tmp_path, "a.stl", f"solid a\n{text}endsolid a\n"))
    assert mesh.vertices.shape == (4, 3)
    assert np.array_equal(mesh.vertices[mesh.faces], corners)


def test_gltf_reads_the_buffers_beside_it_and_moves_its_nodes(tmp_path):
    content = SQUARE[:3].astype("<f4").tobytes() + np.array([0, 1, 2], "<u4").tobytes()
    written(tmp_path, "corners.bin", content)
    mesh = read_mesh(written(tmp_path, "a.gltf", json.dumps(gltf())))
    x, y, z = (SQUARE[:3] + np.array([10, 0, 0])).T
    assert np.array_equal(mesh.vertices[mesh.faces[0]], np.column_stack([x, -z, y]))  # up is y in glTF, z here


def test_a_mirrored_node_keeps_the_outside_outside(tmp_path):
    content = SQUARE[:3].astype("<f4").tobytes() + np.array([0, 1, 2], "<u4").tobytes()
    written(tmp_path, "corners.bin", content)
    document = gltf(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}])
    mesh = read_mesh(written(tmp_path, "a.gltf", json.dumps(document)))
    assert mesh.area_vectors()[0, 1] < 0  # up is y in glTF, z here: what looked along z looks along -y


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("few.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n"),
        ("counts.off", "OFF\n2147483648 1 0\n0 0 0\n"),
        ("corners.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n5 0 1 2\n"),
        ("colors.off", "COFF\n3 1 0\n0 0 0 1 2 3 255\n1 0 0 1 2 3 255\n0 1 0\n3 0 1 2\n"),
        ("large.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 99999999999999999999\n"),
        ("negative.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 -1\n"),
        ("beyond.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"),
        ("index.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999\n"),
        ("words.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 x\n"),
        ("none.obj", "f 1 2 3\n"),
        ("short.stl", b"\0" * 80 + b"\1\0\0\0" + b"\0" * 49),
        ("deep.gltf", "[" * 100_000),
        ("huge.gltf", json.dumps(gltf(accessors=[{"componentType": 5126, "count": 10**12, "type": "VEC3"}] * 2))),
        ("count.gltf", json.dumps(gltf(count=10**12))),
        ("outside.gltf", json.dumps(gltf(buffers=[{"byteLength": 48, "uri": "../../../../../dev/zero"}]))),
        ("cut.glb", b"glTF\2\0\0\0"),
        ("noz.ply", PLY.replace("property float z\n", "") + "3 0 1 2\n3 0 2 3\n"),
        ("list.ply", PLY.replace("list uchar int vertex_indices", "list uchar int else") + "3 0 1 2\n3 0 2 3\n"),
        ("float.ply", PLY.replace("uchar int vertex", "uchar float vertex") + "3 0 1 2\n3 0 2 3\n"),
        ("rows.ply", PLY + "3 0 1 2\n"),
        ("empty.npz", b""),
    ],
)
def test_a_damaged_mesh_is_an_input_error_that_names_the_file(tmp_path, name, content):
    with pytest.raises(InputError, match=name):
        read_mesh(written(tmp_path, name, content))


def test_an_array_longer_than_its_file_is_not_allocated(tmp_path):
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("vertices", "faces"):
            header = io.BytesIO()
            np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
            archive.writestr(f"{name}.npy", header.getvalue() + b"0" * 24)
    with pytest.raises(InputError, match=r"a\.npz.*too short"):
        read_mesh(path)
