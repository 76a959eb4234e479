"""LAS and LAZ: files written by laspy itself go through unchanged, and other clouds become such files."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from jetnormal import formats
from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError

laspy = pytest.importorskip("laspy")
pytest.importorskip("lazrs")

COUNT = 200


def lidar_file(path, point_format=6, version="1.4", records=True, extra=()):
    """A file with random numbers in every dimension."""
    rng = np.random.default_rng(point_format)
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.001, 0.01, 0.0025], [400_000, 5_000_000, -17.5]
    header.system_identifier, header.file_source_id = "a scanner", 77
    header.add_extra_dims([laspy.ExtraBytesParams(*params[:2], **dict(params[2:])) for params in extra])
    if records:
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "OGC WKT", b"PROJCS[no end"))
        header.vlrs.append(laspy.VLR("somebody", 9, "of our own", bytes(range(256))))
    las = laspy.LasData(header)
    las.X, las.Y, las.Z = rng.integers(-(2**31), 2**31 - 1, (3, COUNT), np.int64).astype("i4")
    for dimension in las.point_format.dimensions:
        if dimension.name in "XYZ":
            continue
        high = min(int(dimension.max), 2**15) if dimension.is_standard else 100
        high = 300 if dimension.is_scaled else high
        shape = (COUNT,) if dimension.num_elements == 1 else (COUNT, dimension.num_elements)
        las[dimension.name] = rng.integers(0, high + 1, shape)
    las["return_number"] = np.ones(COUNT, np.uint8)
    if records and version == "1.4":
        las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("late", 5, "behind the points", b"x" * 300)])
    las.write(str(path))
    return path


def records_of(path):
    """Every record of the header and behind the points, as bytes, read without laspy."""
    data = path.read_bytes()
    position, _, count = struct.unpack_from("<HII", data, 94)
    found = []
    for _ in range(count):
        _, user, number, length, text = struct.unpack_from("<H16sHH32s", data, position)
        found.append((user, number, text, data[position + 54 : position + 54 + length]))
        position += 54 + length
    position, count = struct.unpack_from("<QI", data, 235) if data[25] >= 4 else (0, 0)
    for _ in range(count):
        _, user, number, length, text = struct.unpack_from("<H16sHQ32s", data, position)
        found.append((user, number, text, data[position + 60 : position + 60 + length]))
        position += 60 + length
    return [record for record in found if record[1] != 22204]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("point_format", range(11))
def test_every_point_format_goes_through_unchanged(tmp_path, point_format, suffix):
    version = "1.4" if point_format > 5 else "1.3"
    path = lidar_file(tmp_path / f"in{suffix}", point_format, version)
    cloud = formats.read(path)
    if suffix == ".laz" and point_format in (9, 10):
        assert "wave packets" in cloud.source.notes[0]
        (warning,) = formats.write(cloud, tmp_path / f"out{suffix}")
        assert f"point format {point_format}" in warning
        again = formats.read(tmp_path / "out.laz")
        assert list(again.attributes) == list(cloud.attributes)
        assert all((again.attributes[name] == cloud.attributes[name]).all() for name in cloud.attributes)
        return
    assert formats.write(cloud, tmp_path / f"out{suffix}") == []
    before, after = laspy.read(path), laspy.read(tmp_path / f"out{suffix}")
    assert before.points.array.tobytes() == after.points.array.tobytes()
    if suffix == ".las":
        assert path.read_bytes() == (tmp_path / "out.las").read_bytes()
    assert records_of(path) == records_of(tmp_path / f"out{suffix}")


def test_normals_and_attributes_become_extra_dimensions(tmp_path):
    extra = [
        ("scaled", "i2", ("scales", np.array([0.01])), ("offsets", np.array([5.0])), ("description", "meters")),
        ("bytes", "5u1"),
        ("pair", "2f4"),
        ("ratio", "f8", ("no_data", np.array([-1.0]))),
    ]
    path = lidar_file(tmp_path / "in.laz", 7, extra=extra)
    cloud = formats.read(path)
    assert cloud.attributes["pair"].shape == (COUNT, 2) and cloud.attributes["bytes"].shape == (COUNT, 5)
    normals = np.random.default_rng(0).normal(size=(COUNT, 3)).astype(np.float32)
    added = {
        "confidence": np.linspace(0, 1, COUNT, dtype=np.float32),
        "a name of more than thirty-two letters": normals[:, 0],
    }
    cloud = Cloud(cloud.points, normals, cloud.attributes | added, cloud.source)
    warnings = formats.write(cloud, tmp_path / "out.laz")
    assert "letters' is written as 'a_name_of_more_than_thirty-two_l" in warnings[-1]
    las = laspy.read(tmp_path / "out.laz")
    assert list(las.point_format.extra_dimension_names)[-5:-2] == ["NormalX", "NormalY", "NormalZ"]
    np.testing.assert_array_equal(np.stack([las.NormalX, las.NormalY, las.NormalZ], axis=1), normals)
    again = formats.read(tmp_path / "out.laz")
    np.testing.assert_array_equal(again.normals, normals)
    for name in cloud.source.columns:
        if name in cloud.attributes:
            assert again.attributes[name].tobytes() == cloud.attributes[name].tobytes(), name
    np.testing.assert_array_equal(again.attributes["confidence"], added["confidence"])
    (old,), (new,) = ([r for r in records_of(tmp_path / f) if r[1] == 4] for f in ("in.laz", "out.laz"))
    assert new[3].startswith(old[3]) and len(new[3]) == len(old[3]) + 5 * 192
    assert {record for record in records_of(path) if record[1] != 4} <= set(records_of(tmp_path / "out.laz"))


@pytest.mark.parametrize("names", [("nx", "ny", "nz"), ("Nx", "Ny", "Nz"), ("normal x", "normal y", "normal z")])
def test_normals_keep_the_names_that_they_had(tmp_path, names):
    path = lidar_file(tmp_path / "in.las", extra=[(name, "f8") for name in names])
    cloud = formats.read(path)
    assert cloud.normals is not None and not set(names) & set(cloud.attributes)
    formats.write(cloud, tmp_path / "out.las")
    assert path.read_bytes() == (tmp_path / "out.las").read_bytes()


def test_an_attribute_that_does_not_fit_the_dimension_of_its_name_gets_one_of_its_own(tmp_path):
    scaled = ("scaled", "i2", ("scales", np.array([0.01])), ("offsets", np.array([5.0])))
    cloud = formats.read(lidar_file(tmp_path / "in.las", extra=[("confidence", "u1"), scaled]))
    cloud.attributes["confidence"] = np.full(COUNT, 0.25, np.float32)
    cloud.attributes["user_data"] = np.full(COUNT, 1000)
    cloud.attributes["scaled"] = np.full(COUNT, 1e6)
    formats.write(cloud, tmp_path / "out.las")
    again = formats.read(tmp_path / "out.las").attributes
    assert (again["scaled_2"] == 1e6).all()
    assert (again["confidence_2"] == 0.25).all() and (again["user_data_2"] == 1000).all()


def test_other_clouds_become_las(tmp_path):
    points = np.round(np.random.default_rng(1).uniform(0, 90, (50, 3)), 3)
    points += [5e5, 5e6, 100]
    points[7] = np.nan
    attributes = {
        **dict.fromkeys(("red", "green", "blue"), np.arange(50, dtype=np.uint8)),
        "intensity": np.linspace(0, 1, 50, dtype=np.float32),
        "classification": np.full(50, 6),
        "label": np.arange(50) - 3,
    }
    normals = np.tile([0, 0.6, 0.8], (50, 1))
    warnings = formats.write(Cloud(points, normals, attributes), tmp_path / "a.laz")
    assert any("1 points without finite" in warning for warning in warnings)
    assert any("'intensity' is scaled" in warning for warning in warnings) and len(warnings) == 2
    las = laspy.read(tmp_path / "a.laz")
    assert las.header.scales.tolist() == [0.001] * 3 and las.header.point_format.id == 7
    kept = np.isfinite(points[:, 0])
    np.testing.assert_allclose(las.xyz, points[kept], atol=1e-8)
    assert (las.red == attributes["red"][kept] * np.uint16(257)).all() and (las.classification == 6).all()
    assert (las.label == attributes["label"][kept]).all() and las.header.number_of_points_by_return[0] == 49
    np.testing.assert_array_equal(formats.read(tmp_path / "a.laz").normals, normals[kept].astype(np.float32))


def test_coordinates_between_the_finest_steps_are_rounded_and_said_so(tmp_path):
    points = np.random.default_rng(1).uniform(-1e4, 1e4, (20, 3))
    warnings = formats.write(Cloud(points), tmp_path / "a.las")
    assert len(warnings) == 3 and "x is rounded to multiples of 1e-05" in warnings[0]
    np.testing.assert_allclose(formats.read(tmp_path / "a.las").points, points, atol=0.5e-5)


@pytest.mark.parametrize("size", [1e-3, 1e-5, 1e-7])
def test_a_tiny_cloud_keeps_its_shape(tmp_path, size):
    points = np.random.default_rng(0).random((30, 3)) * size
    formats.write(Cloud(points), tmp_path / "a.las")
    np.testing.assert_allclose(formats.read(tmp_path / "a.las").points, points, rtol=0, atol=1e-12)


def test_single_precision_needs_no_warning(tmp_path):
    points = np.random.default_rng(1).uniform(-90, 90, (20, 3)).astype(np.float32)
    cloud = Cloud(points, source=Source(point_dtype=np.dtype(np.float32)))
    assert formats.write(cloud, tmp_path / "a.las") == []
    np.testing.assert_allclose(formats.read(tmp_path / "a.las").points, points, atol=1e-7)


def test_the_records_are_missed_in_other_formats(tmp_path):
    (warning,) = formats.write(formats.read(lidar_file(tmp_path / "in.las")), tmp_path / "a.ply")
    assert "3 records" in warning and "coordinate system" in warning


def test_an_octree_is_read_and_not_promised(tmp_path):
    las = laspy.read(lidar_file(tmp_path / "in.las"))
    las.header.vlrs.insert(0, laspy.VLR("copc", 1, "copc info", bytes(160)))
    las.evlrs.append(laspy.VLR("copc", 1000, "hierarchy", bytes(32)))
    las.write(str(tmp_path / "in.copc.laz"))
    (warning,) = formats.write(formats.read(tmp_path / "in.copc.laz"), tmp_path / "out.copc.laz")
    assert "plain LAZ" in warning
    assert not [record for record in records_of(tmp_path / "out.copc.laz") if record[0].startswith(b"copc")]


def test_empty_files_go_through(tmp_path):
    laspy.LasData(laspy.LasHeader(version="1.4", point_format=6)).write(str(tmp_path / "in.las"))
    cloud = formats.read(tmp_path / "in.las")
    assert len(cloud) == 0
    formats.write(cloud, tmp_path / "out.laz")
    assert len(formats.read(tmp_path / "out.laz")) == 0


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_damaged_files_are_named(tmp_path, suffix):
    whole = lidar_file(tmp_path / f"in{suffix}").read_bytes()
    path = tmp_path / f"bad{suffix}"
    for data in (b"", b"LASF", whole[:200], whole[:400], whole[: len(whole) * 3 // 4], b"PK" + whole[2:]):
        path.write_bytes(data)
        with pytest.raises(InputError, match=f"bad{suffix}: "):
            formats.read(path)
    count = struct.pack("<Q", 2**60)
    path.write_bytes(whole[:247] + count + whole[255:])
    with pytest.raises(InputError):
        formats.read(path)


def test_a_table_of_chunks_that_asks_for_all_memory_is_refused(tmp_path):
    """lazrs ends the process when it cannot have the memory for it."""
    data = bytearray(lidar_file(tmp_path / "in.laz").read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    struct.pack_into("<I", data, table + 4, 2**32 - 1)
    (tmp_path / "bad.laz").write_bytes(data)
    with pytest.raises(InputError, match="compressed chunks"):
        formats.read(tmp_path / "bad.laz")


def test_a_chunk_that_ends_behind_the_table_is_refused(tmp_path):
    """A chunk of any length would hold layers of any length, for which lazrs ends the process."""
    data = bytearray(lidar_file(tmp_path / "in.laz", records=False).read_bytes())
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    del data[table - 1 : table]
    struct.pack_into("<q", data, start, table - 1)
    (tmp_path / "bad.laz").write_bytes(data)
    with pytest.raises(InputError, match="behind the table"):
        formats.read(tmp_path / "bad.laz")


def test_points_too_long_to_be_compressed_are_refused(tmp_path):
    """lazrs ends the process when it cannot have the memory for the statistics of each byte."""
    data = bytearray(lidar_file(tmp_path / "in.las", records=False).read_bytes())
    struct.pack_into("<H", data, 105, 9000)  # the bytes that no record describes are kept as they are
    data += bytes(COUNT * 9000)
    (tmp_path / "in.las").write_bytes(data)
    cloud = formats.read(tmp_path / "in.las")
    with pytest.raises(InputError, match=r"out\.laz: points of 9000 bytes.*\.las"):
        formats.write(cloud, tmp_path / "out.laz")
    assert not (tmp_path / "out.laz").exists()
    formats.write(cloud, tmp_path / "out.las")
