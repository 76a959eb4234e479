"""E57: files written by pye57 are read in the common frame, and go through; other clouds become such files."""

from __future__ import annotations

import signal
import sys
from dataclasses import replace

import numpy as np
import pytest

from jetnormal import formats
from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.scans import Pose, quaternion_of, rotation_of

pye57 = pytest.importorskip("pye57")

COUNT = 60
QUATERNIONS = np.array([[0.6, 0.0, 0.0, 0.8], [0.5, -0.5, 0.5, 0.5]])
POSITIONS = np.array([[4e5, 5e6, 100.0], [4e5 + 30, 5e6 - 20, 101.5]])


def scan_file(path, invalid=0):
    """Two scans of random points, written by pye57's own writer, and their points in the common frame."""
    rng = np.random.default_rng(0)
    everywhere = []
    with pye57.E57(str(path), mode="w") as file:
        for quaternion, position in zip(QUATERNIONS, POSITIONS, strict=True):
            local = rng.uniform(-10, 10, (COUNT, 3)).astype(np.float32).astype(np.float64)
            data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), local.T.copy(), strict=True))
            data["intensity"] = rng.random(COUNT).astype(np.float32)
            data |= {f"color{c}": rng.integers(0, 256, COUNT).astype(np.uint8) for c in ("Red", "Green", "Blue")}
            data |= {name: rng.integers(0, 900, COUNT).astype(np.uint16) for name in ("rowIndex", "columnIndex")}
            if invalid:
                data["cartesianInvalidState"] = np.r_[np.full(invalid, 2), np.zeros(COUNT - invalid)].astype(np.int8)
            file.write_scan_raw(data, name="wall", rotation=quaternion, translation=position)
            matrix = pye57.ScanHeader(file.data3d[len(everywhere)]).rotation_matrix
            everywhere.append(local[invalid:] @ matrix.T + position)
    return np.concatenate(everywhere)


def raw_scans(path):
    with pye57.E57(str(path)) as file:
        return [file.read_scan_raw(index, ignore_unsupported_fields=True) for index in range(file.scan_count)]


def test_scans_come_into_the_common_frame(tmp_path):
    expected = scan_file(tmp_path / "a.e57", invalid=7)
    cloud = formats.read(tmp_path / "a.e57")
    np.testing.assert_allclose(cloud.points, expected, atol=1e-8)
    assert cloud.source.notes == ("14 points that were not measured are left out",)
    assert np.array_equal(cloud.attributes["scan"], np.repeat([0, 1], COUNT - 7))
    assert np.array_equal(cloud.source.sensors, np.repeat(POSITIONS, COUNT - 7, axis=0))
    assert {"intensity", "red", "green", "blue", "row", "column"} <= set(cloud.attributes)
    assert cloud.attributes["red"].dtype == np.uint8


def test_a_file_goes_through(tmp_path):
    scan_file(tmp_path / "a.e57")
    cloud = formats.read(tmp_path / "a.e57")
    assert formats.write(cloud, tmp_path / "b.e57") == []
    for before, after in zip(raw_scans(tmp_path / "a.e57"), raw_scans(tmp_path / "b.e57"), strict=True):
        assert before.keys() == after.keys()
        for name in before:
            np.testing.assert_array_equal(before[name], after[name], err_msg=name)
    with pye57.E57(str(tmp_path / "a.e57")) as before, pye57.E57(str(tmp_path / "b.e57")) as after:
        for index in range(2):
            first, second = before.get_header(index), after.get_header(index)
            assert first.guid == second.guid and second["name"].value() == "wall"
            np.testing.assert_allclose(first.rotation_matrix, second.rotation_matrix, atol=1e-15)
            np.testing.assert_array_equal(first.translation, second.translation)
    again = formats.read(tmp_path / "b.e57")
    assert again.attributes.keys() == cloud.attributes.keys()
    np.testing.assert_allclose(again.points, cloud.points, rtol=1e-15)


def test_normals_are_written_in_the_frame_of_each_scan(tmp_path):
    scan_file(tmp_path / "a.e57")
    cloud = formats.read(tmp_path / "a.e57")
    normals = np.random.default_rng(1).normal(size=(2 * COUNT, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    added = {"confidence": np.linspace(0, 1, 2 * COUNT, dtype=np.float32), "label": np.arange(2 * COUNT) - 70000}
    source = replace(cloud.source, normal_dtype=np.dtype(np.float32))
    formats.write(Cloud(cloud.points, normals, cloud.attributes | added, source), tmp_path / "b.e57")
    again = formats.read(tmp_path / "b.e57")
    np.testing.assert_allclose(again.normals, normals, atol=1e-7)
    for name, values in added.items():
        np.testing.assert_array_equal(again.attributes[name], values)
    libe57 = pye57.libe57
    image = libe57.ImageFile(str(tmp_path / "b.e57"), "r")
    points = image.root()["data3D"][0]["points"]
    local = [np.empty(COUNT, np.float32) for _ in range(3)]
    buffers = libe57.VectorSourceDestBuffer()
    for axis, array in zip("XYZ", local, strict=True):
        buffers.append(libe57.SourceDestBuffer(image, f"nor:normal{axis}", array, COUNT, True, True))
    points.reader(buffers).read()
    image.close()
    expected = Pose(rotation_of(QUATERNIONS[0])).turn(np.stack(local, axis=1).astype(float))
    np.testing.assert_allclose(expected, normals[:COUNT], atol=1e-7)


def spherical_file(path, distances, azimuths, elevations):
    """One scan without a pose whose points are known by range and angles alone."""
    libe57 = pye57.libe57
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
        prototype = libe57.StructureNode(image)
        buffers = libe57.VectorSourceDestBuffer()
        arrays = [np.asarray(values, dtype=np.float64) for values in (distances, azimuths, elevations)]
        for name, array in zip(names, arrays, strict=True):
            prototype.set(name, libe57.FloatNode(image, 0.0))
            buffers.append(libe57.SourceDestBuffer(image, name, array, len(array), True, True))
        scan = libe57.StructureNode(image)
        scan.set("guid", libe57.StringNode(image, "{1}"))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("points", points)
        file.data3d.append(scan)
        writer = points.writer(buffers)
        writer.write(len(arrays[0]))
        writer.close()


def test_range_and_angles_become_coordinates(tmp_path):
    spherical_file(tmp_path / "a.e57", [2, 3, 5], [0, np.pi / 2, 0.3], [0, 0, np.pi / 2])
    cloud = formats.read(tmp_path / "a.e57")
    np.testing.assert_allclose(cloud.points, [[2, 0, 0], [0, 3, 0], [0, 0, 5]], atol=1e-12)
    assert cloud.source.sensors is None and cloud.source.viewpoint[:3] == (0, 0, 0)
    formats.write(cloud, tmp_path / "b.e57")
    np.testing.assert_array_equal(formats.read(tmp_path / "b.e57").points, cloud.points)


def test_other_clouds_become_e57(tmp_path):
    points = np.random.default_rng(0).normal(size=(30, 3))
    points[4] = np.nan
    colors = dict.fromkeys(("red", "green", "blue"), np.arange(30, dtype=np.uint8))
    source = Source("pcd", "binary", viewpoint=(1.5, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0))
    small = {f"of_{kind}": np.arange(30).astype(kind) - 3 for kind in ("i1", "i2")}
    cloud = Cloud(points, points, {**colors, "a b": np.arange(30), **small}, source)
    lost, warning = formats.write(cloud, tmp_path / "a.e57")
    assert "1 points without finite" in lost and "'a_b'" in warning
    again = formats.read(tmp_path / "a.e57")
    kept = np.isfinite(points[:, 0])
    np.testing.assert_allclose(again.points, points[kept], atol=1e-15)
    assert (again.source.sensors == [1.5, 2, 3]).all()
    assert list(again.attributes) == ["red", "green", "blue", "a_b", "of_i1", "of_i2", "scan"]
    for name, values in small.items():
        assert again.attributes[name].dtype == values.dtype and np.array_equal(again.attributes[name], values[kept])
    formats.write(again, tmp_path / "b.e57")
    assert (tmp_path / "a.e57").read_bytes() != b"" and len(formats.read(tmp_path / "b.e57")) == 29


def test_no_attribute_takes_the_place_of_another(tmp_path):
    """Names that XML does not allow, and the names of the standard's own fields."""
    points = np.random.default_rng(0).normal(size=(4, 3))
    fields = {"cartesianX": np.zeros(4), "cartesianInvalidState": np.ones(4)}
    cloud = Cloud(points, points, {"ä": np.arange(4), "ö": np.arange(4) + 9} | fields)
    first, second = formats.write(cloud, tmp_path / "a.e57")
    assert "attribute 'ä' is written as '_'" in first and "attribute 'ö' is written as '__2'" in second
    again = formats.read(tmp_path / "a.e57")
    np.testing.assert_array_equal(again.points, points)
    assert list(again.attributes) == ["_", "__2", "cartesianX", "cartesianInvalidState", "scan"]
    assert again.attributes["_"].tolist() == [0, 1, 2, 3] and again.attributes["__2"].tolist() == [9, 10, 11, 12]


@pytest.mark.skipif(sys.platform == "win32", reason="sizes of files are not limited there")
def test_a_full_disk_is_an_input_error(tmp_path):
    import resource

    cloud, before = Cloud(np.zeros((1000, 3))), resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, before[1]))
    try:
        with pytest.raises(InputError, match="is the disk full"):
            formats.write(cloud, tmp_path / "a.e57")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.full((2, 3), np.nan)])
def test_a_file_without_points_is_read(tmp_path, points):
    formats.write(Cloud(points), tmp_path / "a.e57")
    assert len(formats.read(tmp_path / "a.e57")) == 0


def test_the_same_cloud_gives_the_same_bytes(tmp_path):
    cloud = Cloud(np.random.default_rng(0).normal(size=(30, 3)))
    for name in ("a.e57", "b.e57"):
        formats.write(cloud, tmp_path / name)
    assert (tmp_path / "a.e57").read_bytes() == (tmp_path / "b.e57").read_bytes()


def test_normals_face_the_scanner_of_their_scan(tmp_path):
    """A wall seen from both sides: only the poses tell which points show which face."""
    from jetnormal.jobs.estimate import EstimateOptions, estimate_file

    rng = np.random.default_rng(0)
    with pye57.E57(str(tmp_path / "wall.e57"), mode="w") as file:
        for side in (-1, 1):
            face = np.stack([np.full(400, 0.1 * side), *rng.uniform(-1, 1, (2, 400))], axis=1)
            local = face - [5.0 * side, 0, 0]
            data = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), local.T.copy(), strict=True))
            file.write_scan_raw(data, translation=np.array([5.0 * side, 0, 0]))
    options = EstimateOptions(model="pca", k=8)
    summary = estimate_file(tmp_path / "wall.e57", tmp_path / "out.e57", options)
    result = formats.read(tmp_path / "out.e57")
    assert summary["orient"]["used"] == "viewpoint"
    facing = np.einsum("nd,nd->n", result.normals, result.source.sensors - result.points)
    assert (facing > 0).mean() >= 0.999


def test_pictures_and_the_coordinate_system_are_kept(tmp_path):
    libe57 = pye57.libe57
    scan_file(tmp_path / "a.e57")
    cloud = formats.read(tmp_path / "a.e57")
    picture = {"guid": ("StringNode", "{2}"), "jpegImage": ("BlobNode", np.arange(250, dtype=np.uint8))}
    root = cloud.source.extra.details.root
    root |= {"images2D": [picture], "coordinateMetadata": ("StringNode", "EPSG:25832")}
    formats.write(cloud, tmp_path / "b.e57")
    formats.write(formats.read(tmp_path / "b.e57"), tmp_path / "c.e57")
    image = libe57.ImageFile(str(tmp_path / "c.e57"), "r")
    assert image.root()["coordinateMetadata"].value() == "EPSG:25832"
    blob = image.root()["images2D"][0]["jpegImage"]
    assert np.array_equal(blob.read_buffer(), np.arange(250))
    image.close()
    assert any(
        "1 pictures" in warning for warning in formats.write(formats.read(tmp_path / "c.e57"), tmp_path / "a.ply")
    )


def test_damaged_files_are_named(tmp_path):
    scan_file(tmp_path / "a.e57")
    whole = (tmp_path / "a.e57").read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for data in (b"", b"ASTM-E57", whole[:100], whole[: len(whole) // 2], bytes(flipped), b"x" + whole):
        (tmp_path / "bad.e57").write_bytes(data)
        with pytest.raises(InputError, match=r"bad\.e57: "):
            formats.read(tmp_path / "bad.e57")


def test_a_file_without_scans_is_named(tmp_path):
    pye57.E57(str(tmp_path / "a.e57"), mode="w").close()
    with pytest.raises(InputError, match="holds no scans"):
        formats.read(tmp_path / "a.e57")


@pytest.mark.parametrize("quaternion", [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.6, -0.8], *QUATERNIONS])
def test_quaternions_and_rotations_tell_the_same(quaternion):
    rotation = rotation_of(quaternion)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(rotation_of(quaternion_of(rotation)), rotation, atol=1e-14)
