"""Points of other libraries: what becomes a cloud, and what does not."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal import Cloud
from jetnormal.convert import library_of, to_cloud, to_open3d
from jetnormal.errors import InputError, JetnormalError, ShapeError
from jetnormal.support.open3d_loader import import_open3d

POINTS = np.random.default_rng(0).random((12, 3))
NORMALS = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)


@pytest.fixture
def open3d():
    return import_open3d() or pytest.skip("Open3D cannot be loaded")


def test_a_cloud_stays_itself():
    cloud = Cloud(POINTS)
    assert to_cloud(cloud) is cloud


@pytest.mark.parametrize("points", [POINTS, POINTS.tolist(), [tuple(row) for row in POINTS], POINTS.astype(">f8")])
def test_arrays_and_lists_are_points(points):
    assert np.array_equal(to_cloud(points).points, POINTS)


def test_masked_points_are_no_points():
    points = np.ma.masked_array(POINTS, np.arange(36).reshape(12, 3) == 4)
    assert np.flatnonzero(~to_cloud(points).valid).tolist() == [1]


def test_organized_points_come_row_by_row_and_are_known_as_such():
    cloud = to_cloud(POINTS.reshape(3, 4, 3))
    assert np.array_equal(cloud.points, POINTS)
    assert (cloud.source.height, cloud.source.width) == (3, 4)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (POINTS[:, :2], r"\(12, 2\)"),
        (POINTS[0], r"\(3,\)"),
        (POINTS.reshape(2, 2, 3, 3), r"\(2, 2, 3, 3\)"),
        (3.0, r"\(\)"),
        ([], r"\(0,\)"),
    ],
)
def test_other_shapes_are_errors_of_jetnormal_and_value_errors(points, words):
    with pytest.raises(ShapeError, match=words) as error:
        to_cloud(points)
    assert isinstance(error.value, JetnormalError) and isinstance(error.value, ValueError)


@pytest.mark.parametrize("points", [[[1, 2, 3], [4]], np.array([["a"] * 3]), None, {"x": 1}, POINTS.astype(complex)])
def test_what_is_not_numbers_is_an_input_error(points):
    with pytest.raises(InputError, match=r"numbers in an array of shape \(N, 3\)"):
        to_cloud(points)


def test_tensors_of_pytorch_also_with_gradients():
    torch = pytest.importorskip("torch")
    tensor = torch.tensor(POINTS, requires_grad=True)
    assert np.array_equal(to_cloud(tensor).points, POINTS)
    assert len(to_cloud(torch.zeros(2, 5, 3))) == 10
    with pytest.raises(ShapeError):
        to_cloud(torch.zeros(5))


def test_a_legacy_cloud_of_open3d_and_back(open3d):
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(POINTS))
    points.colors = open3d.utility.Vector3dVector(np.tile([1, 0.2, 0], (12, 1)))
    cloud = to_cloud(points)
    assert np.array_equal(cloud.points, POINTS) and cloud.normals is None
    assert {name: values[0] for name, values in cloud.attributes.items()} == {"red": 255, "green": 51, "blue": 0}
    found = to_open3d(points, Cloud(POINTS, NORMALS, cloud.attributes))
    assert np.array_equal(np.asarray(found.normals), NORMALS) and found.has_colors() and not points.has_normals()
    with pytest.raises(InputError, match="cannot hold quality"):
        to_open3d(points, Cloud(POINTS, NORMALS, cloud.attributes | {"quality": np.ones(12)}))


def test_a_tensor_cloud_of_open3d_and_back(open3d):
    points = open3d.t.geometry.PointCloud(open3d.core.Tensor(POINTS.astype(np.float32)))
    points.point["intensity"] = open3d.core.Tensor(np.arange(12.0)[:, None])
    cloud = to_cloud(points)
    assert np.allclose(cloud.points, POINTS) and np.array_equal(cloud.attributes["intensity"], np.arange(12.0))
    found = to_open3d(points, Cloud(POINTS, NORMALS, cloud.attributes | {"quality": np.ones(12, np.float32)}))
    assert np.allclose(found.point["normals"].numpy(), NORMALS)
    assert found.point["quality"].shape == (12, 1) and "normals" not in points.point
    assert to_cloud(found).normals is not None


def test_what_is_no_cloud_of_open3d_is_an_input_error(open3d):
    with pytest.raises(InputError, match="TriangleMesh"):
        to_cloud(open3d.geometry.TriangleMesh())


def test_meshes_and_clouds_of_trimesh():
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(1)
    assert np.array_equal(to_cloud(sphere).points, sphere.vertices)
    colored = to_cloud(trimesh.PointCloud(POINTS, colors=np.tile([10, 20, 30, 255], (12, 1))))
    assert [colored.attributes[name][0] for name in ("red", "green", "blue")] == [10, 20, 30]
    assert to_cloud(trimesh.PointCloud(POINTS)).attributes == {}


def test_data_of_pyvista():
    pyvista = pytest.importorskip("pyvista")
    data = pyvista.PolyData(POINTS)
    data.point_data["intensity"] = np.arange(12)
    data.point_data["Normals"] = NORMALS
    cloud = to_cloud(data)
    assert np.allclose(cloud.points, POINTS) and np.allclose(cloud.normals, NORMALS)
    assert np.array_equal(cloud.attributes["intensity"], np.arange(12))


def test_a_class_derived_from_a_library_s_is_known():
    torch = pytest.importorskip("torch")

    class Own(torch.Tensor):
        pass

    assert library_of(torch.zeros(3).as_subclass(Own)) == "torch"
