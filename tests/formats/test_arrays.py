"""NumPy's files, and KITTI's."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, UsageError

POINTS = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)


def test_rows_with_normals_and_more(tmp_path):
    np.save(tmp_path / "a.npy", np.c_[POINTS, NORMALS, np.full(6, 7.5, np.float32)])
    cloud = formats.read(tmp_path / "a.npy")
    assert np.array_equal(cloud.points, POINTS) and np.array_equal(cloud.normals, NORMALS)
    assert cloud.attributes["column_7"].tolist() == [7.5] * 6
    columns = formats.read(tmp_path / "a.npy", columns="z,y,x,-,-,-,time")
    assert np.array_equal(columns.points, POINTS[:, ::-1]) and list(columns.attributes) == ["time"]


def test_a_plain_array_stays_one(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    cloud = formats.read(tmp_path / "a.npy")
    cloud.normals = NORMALS
    formats.write(cloud, tmp_path / "b.npy")
    written = np.load(tmp_path / "b.npy")
    assert written.dtype == np.float32 and np.array_equal(written, np.c_[POINTS, NORMALS])


def test_a_grid_stays_a_grid(tmp_path):
    grid = np.arange(36, dtype=np.float64).reshape(3, 4, 3)
    grid[0, 1] = np.nan
    np.save(tmp_path / "a.npy", grid)
    cloud = formats.read(tmp_path / "a.npy")
    assert (cloud.source.width, cloud.source.height, len(cloud)) == (4, 3, 12)
    cloud.normals = np.tile([0.0, 0, 1], (12, 1))
    formats.write(cloud, tmp_path / "b.npy")
    written = np.load(tmp_path / "b.npy")
    assert written.shape == (3, 4, 6) and np.array_equal(written[..., :3], grid, equal_nan=True)


def test_attributes_make_a_structured_array(tmp_path):
    cloud = Cloud(POINTS, NORMALS, {"label": np.arange(6), "pair": np.ones((6, 2), np.float32)})
    formats.write(cloud, tmp_path / "a.npy")
    assert np.load(tmp_path / "a.npy").dtype.names == ("x", "y", "z", "nx", "ny", "nz", "label", "pair")
    again = formats.read(tmp_path / "a.npy")
    assert np.array_equal(again.points, POINTS) and again.attributes["label"].dtype == np.int64
    assert np.array_equal(again.attributes["pair"], cloud.attributes["pair"])


@pytest.mark.parametrize("name", ["points", "xyz", "pos", "arr_0"])
def test_named_arrays(tmp_path, name):
    np.savez(tmp_path / "a.npz", **{name: POINTS, "Normals": NORMALS, "label": np.arange(6), "scale": np.ones(2)})
    cloud = formats.read(tmp_path / "a.npz")
    assert np.array_equal(cloud.points, POINTS) and np.array_equal(cloud.normals, NORMALS)
    assert list(cloud.attributes) == ["label"] and "scale" in cloud.source.notes[0]
    formats.write(cloud, tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as written:
        assert sorted(written) == ["label", "normals", "points"]
        assert np.array_equal(written["points"], POINTS) and np.array_equal(written["label"], np.arange(6))


def test_an_array_for_each_coordinate(tmp_path):
    np.savez(tmp_path / "a.npz", x=POINTS[:, 0], y=POINTS[:, 1], Z=POINTS[:, 2])
    assert np.array_equal(formats.read(tmp_path / "a.npz").points, POINTS)


def test_names_of_the_arrays_themselves(tmp_path):
    cloud = Cloud(POINTS, attributes={"points": np.arange(6), "file": np.arange(6)})
    assert len(formats.write(cloud, tmp_path / "a.npz")) == 2
    assert list(formats.read(tmp_path / "a.npz").attributes) == ["points_2", "file_2"]


def test_no_attribute_takes_the_place_of_another(tmp_path):
    names = ["points", "points_2", "file", "allow_pickle", "h\udcf6he"]  # the last as a reader decodes Latin-1
    cloud = Cloud(np.eye(3), attributes={name: np.full(3, number) for number, name in enumerate(names)})
    warnings = formats.write(cloud, tmp_path / "a.npz")
    assert [warning.rpartition(" ")[2] for warning in warnings] == [
        "'points_2'", "'points_2_2'", "'file_2'", "'allow_pickle_2'", "'höhe'",
    ]  # fmt: skip
    found = formats.read(tmp_path / "a.npz").attributes
    assert [values[0] for values in found.values()] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(3),
        np.zeros((5, 2)),
        np.zeros((2, 2, 2, 3)),
        np.zeros((3, 3), complex),
        np.array([["a"] * 3]),
        np.array(1),
    ],
)
def test_arrays_that_hold_no_points(tmp_path, array):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(InputError, match=r"a\.npy: "):
        formats.read(tmp_path / "a.npy")


def test_damaged_and_pickled_files_are_named(tmp_path):
    np.save(tmp_path / "a.npy", POINTS)
    whole = (tmp_path / "a.npy").read_bytes()
    np.save(tmp_path / "pickled.npy", np.array([{}], object), allow_pickle=True)
    pickled = (tmp_path / "pickled.npy").read_bytes()
    huge = whole.replace(b"(6, 3), }          ", b"(99999999999, 3), }")
    assert huge != whole
    for data in (b"", b"\x93NUMPY", whole[:20], whole[:-5], pickled, b"PK\x03\x04", huge):
        (tmp_path / "bad.npy").write_bytes(data)
        with pytest.raises(InputError, match=r"bad\.npy: "):
            formats.read(tmp_path / "bad.npy")
    np.savez(tmp_path / "none.npz", other=POINTS)
    with pytest.raises(InputError, match="call it points"):
        formats.read(tmp_path / "none.npz")
    np.savez(tmp_path / "uneven.npz", x=np.ones(3), y=np.ones(3), z=np.ones(2))
    with pytest.raises(InputError, match="the same number of rows"):
        formats.read(tmp_path / "uneven.npz")
    with pytest.raises(UsageError, match="`decimal`"):
        formats.read(tmp_path / "a.npy", decimal="comma")


def test_kitti_scans_know_their_sensor(tmp_path):
    rows = np.c_[POINTS, np.linspace(0, 1, 6)].astype("<f4")
    rows.tofile(tmp_path / "0000.bin")
    cloud = formats.read(tmp_path / "0000.bin", format="kitti")
    assert np.array_equal(cloud.points, POINTS) and not cloud.source.sensors.any()
    assert cloud.attributes["intensity"].dtype == np.float32
    formats.write(cloud, tmp_path / "a.pcd")
    with pytest.raises(InputError, match="`format=kitti`"):
        formats.read(tmp_path / "0000.bin")
    with pytest.raises(InputError, match="cannot hold normals"):
        formats.write(cloud, tmp_path / "b.bin", format="kitti")
    (tmp_path / "bad.bin").write_bytes(b"12345")
    with pytest.raises(InputError, match="no rows of four"):
        formats.read(tmp_path / "bad.bin", format="kitti")
