"""Convert points of other libraries to clouds and back, without importing those libraries.

NumPy arrays and what NumPy makes into one, PyTorch tensors, both kinds of Open3D clouds, and the clouds and meshes of
trimesh and PyVista, of which the vertices are taken.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, Source, unmasked
from jetnormal.errors import InputError, ShapeError


def to_cloud(points: Any) -> Cloud:
    """Make a cloud of points, with their normals and colors where the library holds some; a cloud stays itself.

    Args:
        points: (N, 3) or organized (H, W, 3) coordinates, whose rows come one after the other, or an object of
            PyTorch, Open3D, trimesh or PyVista.

    Raises:
        ShapeError: the coordinates are of another shape.
        InputError: they are no numbers.
    """
    if isinstance(points, Cloud):
        return points
    library = library_of(points)
    return _READERS[library](points) if library in _READERS else _from_array(points)


def library_of(thing: Any) -> str:
    """Tell the package that a value's class, or the class that this one is derived from, comes from."""
    packages = [kind.__module__.partition(".")[0] for kind in type(thing).__mro__]
    return next((package for package in packages if package in _READERS), packages[0])


def to_open3d(original: Any, cloud: Cloud) -> Any:
    """Copy an Open3D cloud, legacy or tensor, and give it the normals of `cloud` and the attributes it lacks.

    Raises:
        InputError: there are such attributes, and the cloud is a legacy one, which has no place for them.
    """
    open3d = sys.modules["open3d"]
    known = to_cloud(original).attributes
    extra = {name: values for name, values in cloud.attributes.items() if known.get(name) is not values}
    extra = {name: values for name, values in extra.items() if name not in known}
    if _is_legacy(original):
        if extra:
            names = ", ".join(extra)
            raise InputError(f"a legacy Open3D cloud cannot hold {names}: pass an open3d.t.geometry.PointCloud")
        found = open3d.geometry.PointCloud(original)
        found.normals = open3d.utility.Vector3dVector(cloud.normals)
        return found
    found = original.clone()
    device, kind = found.point["positions"].device, found.point["positions"].dtype
    found.point["normals"] = open3d.core.Tensor(np.asarray(cloud.normals), kind, device)
    for name, values in extra.items():
        found.point[name] = open3d.core.Tensor(np.ascontiguousarray(values.reshape(len(cloud), -1)), device=device)
    return found


def _from_array(values: Any) -> Cloud:
    try:
        array = unmasked(values)
        if array.dtype.kind not in "fiub":
            raise TypeError
        array = array.astype(np.float64)
    except (TypeError, ValueError):
        raise InputError(f"points must be numbers in an array of shape (N, 3), not {_described(values)}") from None
    if array.ndim == 3 and array.shape[2] == 3:
        height, width, _ = array.shape
        return Cloud(array.reshape(-1, 3), source=Source(width=width, height=height))
    if array.ndim != 2 or array.shape[1] != 3:
        raise ShapeError(f"points must have shape (N, 3) or (H, W, 3), not {array.shape}")
    return Cloud(array)


def _described(values: Any) -> str:
    if isinstance(values, np.ndarray):
        return f"an array of {values.dtype}"
    return f"a {type(values).__name__}" + (" of unequal rows" if isinstance(values, (list, tuple)) else "")


def _from_torch(tensor: Any) -> Cloud:
    return _from_array(tensor.detach().cpu().numpy())


def _from_open3d(points: Any) -> Cloud:
    if _is_legacy(points):
        normals = np.array(points.normals) if points.has_normals() else None
        return Cloud(np.array(points.points), normals, _colors(np.array(points.colors)) if points.has_colors() else {})
    if not hasattr(points, "point"):
        raise InputError(f"points must be a cloud, not an Open3D {type(points).__name__}")
    arrays = {name: points.point[name].cpu().numpy() for name in points.point}
    positions, normals = arrays.pop("positions"), arrays.pop("normals", None)
    return Cloud(positions, normals, {name: _flat(values) for name, values in arrays.items()})


def _is_legacy(points: Any) -> bool:
    return hasattr(points, "has_colors") and hasattr(points, "points")


def _from_trimesh(points: Any) -> Cloud:
    vertices = np.array(points.vertices)
    visual = getattr(points, "visual", None)
    colors = getattr(points, "colors", None)
    if visual is not None and visual.kind == "vertex":
        colors = visual.vertex_colors
    has_colors = colors is not None and np.shape(colors)[:1] == (len(vertices),)
    return Cloud(vertices, None, _colors(np.asarray(colors) / 255) if has_colors else {})


def _from_pyvista(points: Any) -> Cloud:
    arrays = {name: np.array(values) for name, values in points.point_data.items()}
    normals = arrays.pop("Normals", None)
    return Cloud(np.array(points.points), normals, {name: _flat(values) for name, values in arrays.items()})


def _colors(colors: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Colors (N, 3 or 4) from 0 to 1 as the attributes that a file would have."""
    levels = np.round(np.clip(colors[:, :3], 0, 1) * 255).astype(np.uint8)
    return dict(zip(("red", "green", "blue"), levels.T, strict=True))


def _flat(values: NDArray[Any]) -> NDArray[Any]:
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


_READERS: dict[str, Callable[[Any], Cloud]] = {
    "torch": _from_torch,
    "open3d": _from_open3d,
    "trimesh": _from_trimesh,
    "pyvista": _from_pyvista,
}
