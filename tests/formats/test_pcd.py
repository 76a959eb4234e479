from __future__ import annotations

import struct

import numpy as np
import pytest

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats import lzf, read, write

ENCODINGS = ("ascii", "binary", "binary_compressed")
NORMALS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1], [np.nan] * 3, [1, 0, 0]])


def odd_cloud(coordinates="f4") -> Cloud:
    """Three by two organized points, one of them NaN, with every type PCD knows and a field of COUNT 4."""
    random = np.random.default_rng(0)
    points = random.normal(0, 1000, (6, 3)).astype(coordinates)
    points[4] = np.nan
    attributes = {
        f"{kind}{size}": random.integers(0, 256, 6 * size, dtype=np.uint8).view(f"{kind}{size}")
        for kind in "iu"
        for size in (1, 2, 4, 8)
    }
    attributes["f8"] = random.normal(0, 1, 6)
    attributes["rgb"] = np.array([0xFF102030, 0x7FC00001, 0, 1, 0x00FFFFFF, 0x80FF0080], "u4").view("f4")
    attributes["histogram"] = random.normal(0, 1, (6, 4)).astype("f4")
    source = Source(
        format="pcd",
        comments=("Prüfstück",),
        viewpoint=(1.5, -2.0, 1e-9, 0.0, 1.0, 0.0, 0.0),
        width=3,
        height=2,
        columns=("rgb", "x", "histogram", "y", "z"),
        point_dtype=np.dtype(coordinates),
    )
    return Cloud(points, None, attributes, source)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("coordinates", ["f4", "f8", "i4"])
def test_everything_survives_writing_and_reading(tmp_path, encoding, coordinates):
    cloud = odd_cloud("f8" if coordinates == "f8" else "f4")
    if coordinates == "i4":
        cloud.points[:] = np.arange(18).reshape(6, 3)
        cloud = Cloud(cloud.points, None, cloud.attributes, Source(point_dtype=np.dtype("i4")))
    assert write(cloud, tmp_path / "a.pcd", encoding=encoding) == []
    again = read(tmp_path / "a.pcd")
    assert again.points.tobytes() == cloud.points.tobytes()
    assert again.source.point_dtype == coordinates
    for name, values in cloud.attributes.items():
        assert again.attributes[name].tobytes() == values.tobytes(), name
        assert again.attributes[name].dtype == values.dtype or (name, encoding) == ("rgb", "ascii")
    if coordinates != "i4":
        assert again.source.columns[:5] == cloud.source.columns
        assert again.source.viewpoint == cloud.source.viewpoint
        assert (again.source.width, again.source.height) == (3, 2)
        assert again.source.comments == cloud.source.comments
    write(again, tmp_path / "b.pcd")
    assert (tmp_path / "b.pcd").read_bytes() == (tmp_path / "a.pcd").read_bytes()


def header_of(path) -> dict[str, list[str]]:
    text = path.read_bytes().split(b"DATA")[0].decode()
    return {line.split()[0]: line.split()[1:] for line in text.splitlines()}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_new_normals_come_with_a_curvature_as_floats(tmp_path, encoding):
    cloud = odd_cloud("f8")
    cloud.normals = NORMALS
    cloud.attributes["curvature"] = np.linspace(0, 1, 6)
    write(cloud, tmp_path / "a.pcd", encoding=encoding)
    header = header_of(tmp_path / "a.pcd")
    start = header["FIELDS"].index("normal_x")
    assert header["FIELDS"][start - 1 : start + 4] == ["z", "normal_x", "normal_y", "normal_z", "curvature"]
    assert header["SIZE"][start : start + 4] == ["4"] * 4
    again = read(tmp_path / "a.pcd")
    np.testing.assert_array_equal(again.normals, NORMALS)
    np.testing.assert_array_equal(again.attributes["curvature"], np.linspace(0, 1, 6).astype("f4"))


def test_an_unknown_curvature_is_zero_but_is_not_added_beside_old_normals(tmp_path):
    write(Cloud(np.ones((6, 3)), NORMALS), tmp_path / "a.pcd")
    again = read(tmp_path / "a.pcd")
    assert again.attributes["curvature"].tolist() == [0] * 6
    del again.attributes["curvature"]
    write(again, tmp_path / "b.pcd")
    assert header_of(tmp_path / "b.pcd")["FIELDS"] == ["x", "y", "z", "normal_x", "normal_y", "normal_z"]


def test_a_part_of_an_organized_cloud_is_one_row(tmp_path):
    cloud = odd_cloud()
    part = Cloud(cloud.points[:4], None, {}, cloud.source)
    write(part, tmp_path / "a.pcd")
    header = header_of(tmp_path / "a.pcd")
    assert (header["WIDTH"], header["HEIGHT"], header["POINTS"]) == (["4"], ["1"], ["4"])


def pcd(body, data="ascii", fields="x y z", size="4 4 4", kind="F F F", points=2, extra="") -> bytes:
    text = f"# .PCD v.7\nVERSION .7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\n{extra}WIDTH {points}\nHEIGHT 1\n"
    text += f"POINTS {points}\nDATA {data}\n"
    return text.encode() + body


def test_a_header_without_count_viewpoint_and_points(tmp_path):
    text = "FIELDS x y z a a\nSIZE 4 4 4 1 1\nTYPE F F F U U\nWIDTH 2\nDATA ascii\n1 2 3 4 5\nnan 5e-1 6 7 8"
    (tmp_path / "a.pcd").write_bytes(text.replace("\n", "\r\n").encode())
    cloud = read(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [np.nan, 0.5, 6]])
    assert [values.tolist() for values in cloud.attributes.values()] == [[4, 7], [5, 8]]


def test_the_padding_of_pcls_structures_is_no_attribute(tmp_path):
    """PCL's binary files of pcl::PointXYZI hold x y z, 4 bytes of padding, intensity, and 12 bytes of it."""
    table = np.zeros(2, [("xyz", "<f4", 3), ("gap", "V4"), ("intensity", "<f4"), ("end", "V12")])
    table["xyz"], table["intensity"] = [[1, 2, 3], [4, 5, 6]], [0.25, 0.5]
    fields = {"fields": "x y z _ intensity _", "size": "4 4 4 1 4 1", "kind": "F F F U F U"}
    (tmp_path / "a.pcd").write_bytes(pcd(table.tobytes(), "binary", **fields, extra="COUNT 1 1 1 4 1 12\n"))
    cloud = read(tmp_path / "a.pcd")
    assert cloud.points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert {name: values.tolist() for name, values in cloud.attributes.items()} == {"intensity": [0.25, 0.5]}
    write(cloud, tmp_path / "b.pcd")
    assert header_of(tmp_path / "b.pcd")["FIELDS"] == ["x", "y", "z", "intensity"]


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_no_points_at_all(tmp_path, encoding):
    write(Cloud(np.empty((0, 3))), tmp_path / "a.pcd", encoding=encoding)
    assert read(tmp_path / "a.pcd").points.shape == (0, 3)


def compressed(packed, unpacked_size, packed_size=None) -> bytes:
    size = len(packed) if packed_size is None else packed_size
    return pcd(struct.pack("<II", size, unpacked_size) + packed, "binary_compressed")


BAD = {
    "empty": (b"", "no DATA line"),
    "wrong magic": (b"ply\nformat ascii 1.0\n", "line 1: 'ply' is no PCD header"),
    "binary rubbish": (bytes(range(256)) * 10, "is no PCD header"),
    "header cut": (pcd(b"").partition(b"WIDTH")[0], "no DATA line"),
    "sizes missing": (pcd(b"", size="4 4"), "same number of entries"),
    "unknown type": (pcd(b"", kind="F F Q"), "field 'z' has TYPE Q, SIZE 4"),
    "zero count": (pcd(b"", extra="COUNT 1 1 0\n"), "COUNT 0"),
    "no number": (pcd(b"", points="many"), "invalid literal for int.* 'many'"),
    "negative": (pcd(b"", points=-1), "number of points is unclear"),
    "contradiction": (pcd(b"", extra="HEIGHT 1\n").replace(b"POINTS 2", b"POINTS 3"), "points is unclear"),
    "short viewpoint": (pcd(b"", extra="VIEWPOINT 0 0 0\n"), "VIEWPOINT does not hold 7 numbers"),
    "unknown data": (pcd(b"", "zip"), "DATA zip is none of"),
    "no z": (pcd(b"1 2\n3 4\n", fields="x y", size="4 4", kind="F F"), "no column 'z' among x, y"),
    "x is a vector": (pcd(b"1 1 2 3\n", extra="COUNT 2 1 1\n", points=1), "'x' must hold one number"),
    "ascii truncated": (pcd(b"1.00000 2.00000 3.00000\n"), "declares 2 points but holds 1"),
    "ascii word": (pcd(b"1 2 3\n4 5 six\n"), "line 11: 'six' is not a number of type float32"),
    "ascii row long": (pcd(b"1 2 3 4\n5 6 7\n"), "line 10: 4 values instead of 3"),
    "ascii too long": (pcd(b"1 2 3\n" * 3), "more than the 2 points"),
    "ascii huge count": (pcd(b"1 2 3\n", points=10**15), "declares 1000000000000000 points"),
    "binary truncated": (pcd(b"\0" * 23, "binary"), "need at least 24 bytes, but 23 follow"),
    "binary huge count": (pcd(b"\0" * 24, "binary", points=10**15), "declares 1000000000000000 points"),
    "compressed huge count": (pcd(b"\0" * 24, "binary_compressed", points=10**15), "declares 10000"),
    "compressed truncated": (compressed(lzf.compress(b"\0" * 24), 24, 20), "truncated"),
    "compressed size": (compressed(lzf.compress(b"\0" * 24), 23), "need 24 bytes"),
    "compressed damage": (compressed(b"\x01ab\x20\x09", 24), "a match points before the beginning"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_one_clear_line(tmp_path, case):
    data, message = BAD[case]
    path = tmp_path / "bad.pcd"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
