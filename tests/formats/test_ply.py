from __future__ import annotations

import io
import struct

import numpy as np
import plyfile
import pytest

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError
from jetnormal.formats import read, write

pytestmark = pytest.mark.filterwarnings("ignore:loadtxt:UserWarning")  # from plyfile, for empty lists
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
NORMALS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1]])
FACES = [[0, 1, 2], [2, 1, 0, 1]]


def make_ply(path, encoding="ascii", *, lists=False, faces_first=False, coordinates="f8", normals=False):
    """An independent writer: plyfile makes a file with odd properties, faces, comments and obj_info."""
    dtype = [("x", coordinates), ("red", "u1"), ("y", coordinates), ("z", coordinates), ("label", "i2")]
    dtype += [("nx", "f4"), ("ny", "f4"), ("nz", "f4")] if normals else []
    dtype += [("time", "f8"), ("id", "u4")]
    vertices = np.zeros(3, dtype + ([("neighbors", "O")] if lists else []))
    vertices["x"], vertices["y"], vertices["z"] = [0.1, np.nan, 3e5], [1 / 3, 0, -2], [-0.0, 7, 1e-7]
    vertices["red"], vertices["label"], vertices["id"] = [0, 128, 255], [-32768, 0, 5], [0, 7, 2**32 - 1]
    vertices["time"] = [0.1, np.inf, 1e300]
    if normals:
        vertices["nz"] = 1
    if lists:
        vertices["neighbors"] = [np.array(row, "i4") for row in ([1, 2], [], [0])]
    faces = np.array([(np.array(face, "i4"), 7) for face in FACES], [("vertex_indices", "O"), ("part", "u1")])
    elements = [
        plyfile.PlyElement.describe(vertices, "vertex", val_types={"neighbors": "i4"} if lists else {}),
        plyfile.PlyElement.describe(faces, "face"),
    ]
    order = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    plyfile.PlyData(
        elements[::-1] if faces_first else elements,
        text=encoding == "ascii",
        byte_order=order,
        comments=["made by hand"],
        obj_info=["num_cols 3"],
    ).write(str(path))
    return path


def test_big_endian_lists_beside_numbers(tmp_path):
    header = "ply\nformat binary_big_endian 1.0\nelement vertex 2\nproperty float x\nproperty list uchar short l\n"
    header += "property float y\nproperty float z\nend_header\n"
    rows = struct.pack(">fBhhff", 1, 2, -3, 300, 2, 3) + struct.pack(">fBff", 4, 0, 5, 6)
    (tmp_path / "a.ply").write_bytes(header.encode() + rows)
    cloud = read(tmp_path / "a.ply")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    assert [row.tolist() for row in cloud.attributes["l"]] == [[-3, 300], []]
    write(cloud, tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == header.encode() + rows


@pytest.mark.parametrize(
    ("members", "stored", "warnings"),
    [
        ([[1, -2], [], [3]], "int", 0),
        ([[2**32 + 1], [2**60], []], "double", 0),
        ([[2**60 + 1], [7], []], "double", 1),
        ([np.array([1], np.uint32), np.array([-1], np.int16), np.array([], np.int16)], "int", 0),
        ([np.array([], np.int16)] * 3, "short", 0),
        ([["a"], ["b"], []], None, 1),
    ],
)
def test_lists_of_types_that_ply_lacks_are_converted(tmp_path, members, stored, warnings):
    lists = np.empty(3, object)
    lists[:] = [np.array(row) if row else row for row in members] if isinstance(members[0], list) else members
    found = write(Cloud(np.eye(3), attributes={"l": lists}), tmp_path / "a.ply")
    assert len(found) == warnings
    assert (f"property list uchar {stored} l" in (tmp_path / "a.ply").read_text("latin1")) == (stored is not None)
    if stored is not None:
        again = read(tmp_path / "a.ply").attributes["l"]
        for row, expected in zip(again, members, strict=True):
            np.testing.assert_array_equal(row, np.asarray(expected, np.float64 if stored == "double" else None))


def assert_same(first: Cloud, second: Cloud):
    assert first.points.tobytes() == second.points.tobytes()
    assert (first.normals is None) == (second.normals is None)
    assert list(first.attributes) == list(second.attributes)
    for name, values in first.attributes.items():
        other = second.attributes[name]
        if values.dtype == object:
            assert [row.tolist() for row in values] == [row.tolist() for row in other]
        else:
            assert values.dtype.newbyteorder("=") == other.dtype.newbyteorder("=")
            np.testing.assert_array_equal(values, other)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("lists", [False, True])
@pytest.mark.parametrize("faces_first", [False, True])
@pytest.mark.parametrize("coordinates", ["f4", "f8"])
def test_everything_survives_reading_and_writing(tmp_path, encoding, lists, faces_first, coordinates):
    source = make_ply(tmp_path / "a.ply", encoding, lists=lists, faces_first=faces_first, coordinates=coordinates)
    cloud = read(source)
    assert write(cloud, tmp_path / "b.ply") == []
    assert_same(cloud, read(tmp_path / "b.ply"))
    before, after = plyfile.PlyData.read(str(source)), plyfile.PlyData.read(str(tmp_path / "b.ply"))
    assert (after.text, after.byte_order) == (before.text, before.byte_order)
    assert after.comments == ["made by hand"]
    assert after.obj_info == ["num_cols 3"]
    assert str(after["vertex"].header) == str(before["vertex"].header)
    assert [face.tolist() for face in after["face"]["vertex_indices"]] == FACES
    for name in ("x", "y", "z", "red", "label", "time", "id"):
        assert after["vertex"][name].tobytes() == before["vertex"][name].tobytes()


@pytest.mark.parametrize("before", ENCODINGS)
@pytest.mark.parametrize("after", ENCODINGS)
def test_encoding_changes_on_request_with_the_faces(tmp_path, before, after):
    cloud = read(make_ply(tmp_path / "a.ply", before, lists=True))
    assert write(cloud, tmp_path / "b.ply", encoding=after) == []
    again = read(tmp_path / "b.ply")
    assert again.source.encoding == after
    assert_same(cloud, again)
    faces = plyfile.PlyData.read(str(tmp_path / "b.ply"))["face"]
    assert [face.tolist() for face in faces["vertex_indices"]] == FACES
    assert faces["part"].tolist() == [7, 7]


@pytest.mark.parametrize(("coordinates", "expected"), [("f4", "float"), ("f8", "double")])
def test_new_normals_follow_z_in_the_type_of_the_coordinates(tmp_path, coordinates, expected):
    cloud = read(make_ply(tmp_path / "a.ply", "binary_little_endian", coordinates=coordinates))
    cloud.normals = NORMALS
    write(cloud, tmp_path / "b.ply")
    header = (tmp_path / "b.ply").read_bytes().split(b"end_header")[0].decode()
    names = [line.split()[-1] for line in header.splitlines() if line.startswith("property")]
    assert names[:8] == ["x", "red", "y", "z", "nx", "ny", "nz", "label"]
    assert f"property {expected} nx" in header
    np.testing.assert_array_equal(read(tmp_path / "b.ply").normals, NORMALS)


def test_normals_of_the_file_are_replaced_in_place(tmp_path):
    source = make_ply(tmp_path / "a.ply", "binary_big_endian", normals=True)
    cloud = read(source)
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1]] * 3)
    cloud.normals = NORMALS
    write(cloud, source, overwrite=True)
    after = plyfile.PlyData.read(str(source))["vertex"]
    assert [prop.name for prop in after.properties].index("nx") == 5
    assert after["nz"].dtype.itemsize == 4
    np.testing.assert_array_equal(np.stack([after[name] for name in ("nx", "ny", "nz")], 1), NORMALS)


def test_triangle_meshes_are_copied_byte_for_byte(tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    header += "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    faces = np.array([(3, [0, 1, 2]), (3, [2, 1, 0])], [("n", "u1"), ("v", "<i4", 3)])
    data = header.encode() + np.arange(9, dtype="<f4").tobytes() + faces.tobytes()
    (tmp_path / "a.ply").write_bytes(data)
    write(read(tmp_path / "a.ply"), tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == data


def test_faces_go_when_their_points_are_gone(tmp_path):
    cloud = read(make_ply(tmp_path / "a.ply"))
    part = Cloud(cloud.points[:2], None, {k: v[:2] for k, v in cloud.attributes.items()}, cloud.source)
    (warning,) = write(part, tmp_path / "b.ply")
    assert "face" in warning
    assert len(read(tmp_path / "b.ply")) == 2


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_no_vertices_at_all(tmp_path, encoding):
    text = f"ply\nformat {encoding} 1.0\nelement vertex 0\n"
    text += "property float x\nproperty float y\nproperty float z\nend_header"
    (tmp_path / "a.ply").write_text(text)
    cloud = read(tmp_path / "a.ply")
    assert cloud.points.shape == (0, 3)
    write(cloud, tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_text().strip() == text


def ascii_ply(rows, count, properties="float x|float y|float z", extra=""):
    lines = "".join(f"property {prop}\n" for prop in properties.split("|"))
    return f"ply\nformat ascii 1.0\n{extra}element vertex {count}\n{lines}end_header\n{rows}"


def test_windows_line_ends_unicode_comments_and_a_byte_order_mark(tmp_path):
    text = ascii_ply("1 2 3\n4e0 -inf nan\n\n\n", 2, extra="comment Prüfstück 点\n").replace("\n", "\r\n")
    (tmp_path / "a.PLY").write_bytes(b"\xef\xbb\xbf" + text.encode())
    cloud = read(tmp_path / "a.PLY")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, -np.inf, np.nan]])
    assert cloud.source.comments == ("Prüfstück 点",)
    write(cloud, tmp_path / "b.ply")
    assert "comment Prüfstück 点\n" in (tmp_path / "b.ply").read_text(encoding="utf-8")


def test_a_comment_in_an_unknown_encoding_is_kept_as_bytes(tmp_path):
    data = ascii_ply("1 2 3\n", 1, extra="comment COMMENT\n").encode().replace(b"COMMENT", b"\xfc\xe9")
    (tmp_path / "a.ply").write_bytes(data)
    write(read(tmp_path / "a.ply"), tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == data


def test_a_property_named_twice_gets_a_number(tmp_path):
    properties = "float x|float y|float z|uchar a|uchar a"
    (tmp_path / "a.ply").write_text(ascii_ply("1 2 3 4 5\n", 1, properties))
    attributes = read(tmp_path / "a.ply").attributes
    assert {name: values.tolist() for name, values in attributes.items()} == {"a": [4], "a_2": [5]}


def test_ascii_numbers_read_back_to_the_same_bits(tmp_path):
    random = np.random.default_rng(0)
    single = random.integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    double = random.integers(0, 2**64, 20_000, dtype=np.uint64).view(np.float64)
    single[np.isnan(single)], double[np.isnan(double)] = 0.1, 0.1
    cloud = Cloud(np.zeros((20_000, 3)), None, {"single": single, "double": double})
    write(cloud, tmp_path / "a.ply", encoding="ascii")
    again = read(tmp_path / "a.ply").attributes
    assert again["single"].tobytes() == single.tobytes()
    assert again["double"].tobytes() == double.tobytes()


def test_floats_are_written_in_their_shortest_form(tmp_path):
    values = np.array([0.1, 1.5, 100.0, 16777217, 1e-20], np.float32)
    write(Cloud(np.zeros((5, 3)), None, {"v": values}), tmp_path / "a.ply", encoding="ascii")
    text = (tmp_path / "a.ply").read_text().split("end_header\n")[1]
    assert [line.split()[3] for line in text.splitlines()] == ["0.1", "1.5", "100", "16777216", "1e-20"]


XYZ = "property float x\nproperty float y\nproperty float z\n"
BINARY = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + XYZ + "end_header\n"
MESH = BINARY.replace("end_header", "element face 2\nproperty list uchar int i\nend_header")
BAD = {
    "wrong magic": (b"obj\n1 2 3\n", "does not begin with the line 'ply'"),
    "empty": (b"", "does not begin with the line 'ply'"),
    "header cut": (b"ply\nformat ascii 1.0\nelement vertex 3\n", "no end_header"),
    "no format": (b"ply\nelement vertex 3\nend_header\n", "line 3"),
    "unknown format": (b"ply\nformat base64 1.0\n", "line 2: 'format base64 1.0'"),
    "unknown type": (b"ply\nformat ascii 1.0\nelement vertex 3\nproperty quad x\n", "line 4: 'property quad x'"),
    "bad count": (b"ply\nformat ascii 1.0\nelement vertex many\n", "line 3: 'element vertex many'"),
    "no vertices": (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "one element 'vertex'"),
    "no z": (ascii_ply("1 2\n", 1, "float x|float y").encode(), "no column 'z' among x, y"),
    "a list as x": (ascii_ply("1 1 2 3\n", 1, "list uchar float x|float y|float z").encode(), "one number per point"),
    "ascii truncated": (ascii_ply("1 2 3\n1.00000 2.00000 3.00000\n", 3).encode(), "declares 3 points but holds 2"),
    "ascii row short": (ascii_ply("1.0 2.0 3.0\n4 5\n6 7 8\n", 3).encode(), "line 9: 2 values instead of 3"),
    "ascii word": (ascii_ply("1 2 3\n4 5 six\n", 2).encode(), "line 9: 'six' is not a number"),
    "ascii range": (
        ascii_ply("1 2 3 256\n", 1, "float x|float y|float z|uchar red").encode(),
        "line 9: '256' is not a number of type uint8",
    ),
    "ascii too long": (ascii_ply("1 2 3\n4 5 6\n", 1).encode(), "1 rows follow the vertices instead of 0"),
    "ascii huge count": (ascii_ply("1 2 3\n", 10**15).encode(), "only|declares 1000000000000000"),
    "binary truncated": (BINARY.format(2).encode() + b"\0" * 23, "need at least 24 bytes, but 23"),
    "binary huge count": (BINARY.format(10**15).encode() + b"\0" * 24, "declares 1000000000000000"),
    "a list of negative length": (
        BINARY.format(1).replace("end_header", "property list char int l\nend_header").encode() + b"\xff" * 16,
        "element 'vertex': a list has a negative length",
    ),
    "a list with too few numbers": (
        ascii_ply("3 1 2 3 0 0\n", 1, "list uchar float l|float x|float y|float z").encode(),
        "'3 1 2 3 0 0' has too few values",
    ),
    "faces truncated": (
        MESH.format(1).encode() + b"\0" * 12 + b"\3" + b"\0" * 12 + b"\3" + b"\0" * 11,
        "element 'face': the file is truncated",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_one_clear_line(tmp_path, case):
    data, message = BAD[case]
    path = tmp_path / "bad.ply"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_plyfile_reads_what_is_written_from_memory(tmp_path):
    attributes = {"flag": np.array([True, False]), "stamp": np.array([1, 2**60 + 1]), "two": np.ones((2, 2), "f4")}
    warnings = write(Cloud(np.ones((2, 3)), None, attributes), tmp_path / "a.ply")
    assert [("stamp" in text, "two" in text) for text in warnings] == [(True, False), (False, True)]
    vertex = plyfile.PlyData.read(io.BytesIO((tmp_path / "a.ply").read_bytes()))["vertex"]
    names = ["x", "y", "z", "flag", "stamp", "two_0", "two_1"]
    assert [prop.name for prop in vertex.properties] == names


@pytest.mark.parametrize("faces", [(), ((0, 1, 2), (2, 1, 0)), ((0, 1), (0, 1, 2, 1))])
def test_bytes_behind_the_last_element_are_left_out_and_told(tmp_path, faces):
    """They became the last lines of a file that was then written as text."""
    element = f"element face {len(faces)}\nproperty list uchar int vertex_indices\n" if faces else ""
    rows = b"".join(struct.pack(f"<B{len(face)}i", len(face), *face) for face in faces)
    header = BINARY.format(3).replace("end_header", f"{element}end_header")
    (tmp_path / "a.ply").write_bytes(header.encode() + np.arange(9, dtype="<f4").tobytes() + rows + b"\0\xffjunk")
    cloud = read(tmp_path / "a.ply")
    assert cloud.source.notes == ("6 bytes behind the last element are left out",)
    write(cloud, tmp_path / "b.ply", encoding="ascii")
    again = read(tmp_path / "b.ply")
    assert again.points.tolist() == np.arange(9).reshape(3, 3).tolist()
    assert again.source.extra.body.split(b"\n")[:-1] == [
        b" ".join(str(number).encode() for number in (len(face), *face)) for face in faces
    ]
