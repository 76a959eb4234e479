"""Mesh files: PLY, OBJ, STL, OFF and GLB are written and read; glTF with its buffers beside it, and NPZ, are read."""

from __future__ import annotations

import json
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, ResourceError, unreadable
from jetnormal.formats import atomic
from jetnormal.formats.mesh_readers import OFFSET, READERS, to_light, to_y_up
from jetnormal.mesh import Mesh

Rows = NDArray[Any]
FAR = 100.0  # sizes of a mesh from the origin, from which on glTF viewers in single precision show it torn
SINGLE_PRECISION_LOSS = 1e-5  # of a mesh's size: an error of coordinates that is worth a warning


def read_mesh(path: str | PathLike[str]) -> Mesh:
    """Read a triangle mesh from .ply, .obj, .off, .stl, .glb, .gltf, or .npz (arrays `vertices` and `faces`).

    Polygons become triangles, fans around their first corner. The colors of vertices are kept, textures are not.

    Raises:
        InputError: the file is missing, of another type or unreadable, has no faces, has vertices that are
            not finite, or faces that name vertices which do not exist.
        ResourceError: it does not fit into memory.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InputError(f"{path}: not a mesh format that is read here ({' '.join(MESH_SUFFIXES)})")
    try:
        mesh = READERS[suffix](path)
    except OSError as error:
        raise unreadable(path, error) from error
    except MemoryError as error:
        raise ResourceError(f"{path}: does not fit into memory; use a smaller mesh") from error
    vertices, faces = mesh.vertices, mesh.faces
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,) or len(faces) == 0:
        raise InputError(f"{path}: holds no triangles; vertices and faces must be of shape (V, 3) and (F, 3)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: a face names a vertex that does not exist (there are {len(vertices)})")
    if not np.isfinite(vertices).all():
        raise InputError(f"{path}: has vertices that are not finite")
    return mesh


def write_mesh(mesh: Mesh, path: str | PathLike[str], *, overwrite: bool = False) -> list[str]:
    """Write a mesh; the file appears complete or not at all.

    PLY, OBJ and OFF keep float64 coordinates. GLB keeps differences in float32 and their origin in full; of a mesh far
    from the origin, an offset is taken off that stands in the file's extras; z becomes y, which is up in glTF. STL has
    float32 and no colors.

    Args:
        mesh: the mesh.
        path: the target, whose suffix tells the format: .ply, .obj, .stl, .off or .glb.
        overwrite: whether an existing file may be replaced.

    Returns:
        Warnings: what the format cannot hold.

    Raises:
        InputError: the file cannot be written, or its suffix is unknown.
    """
    path = Path(path)
    writer = _writer(path)
    with atomic.atomic_write(path, overwrite=overwrite) as stream:
        warnings = writer(mesh, stream)
    return [f"{path}: {warning}" for warning in warnings]


def check_mesh_target(path: str | PathLike[str], *, overwrite: bool = False) -> None:
    """Find out before a long computation whether `write_mesh` would refuse this path.

    Raises:
        InputError: the suffix is unknown, the file exists and may not be overwritten, or its folder is missing
            or not writable.
    """
    path = Path(path)
    _writer(path)
    atomic.check_target(path, overwrite)


def _writer(path: Path) -> Callable[[Mesh, BinaryIO], list[str]]:
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(f"{path}: {path.suffix!r} is no suffix of a mesh; choose from {' '.join(_WRITERS)}")
    return writer


def _bytes(colors: Rows) -> Rows:
    return np.round(np.clip(colors, 0, 1) * 255).astype(np.uint8)


def _write_ply(mesh: Mesh, stream: BinaryIO) -> list[str]:
    fields: list[Any] = [(axis, "<f8") for axis in "xyz"]
    if mesh.colors is not None:
        fields += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(mesh.vertices), fields)
    for axis, name in enumerate("xyz"):
        rows[name] = mesh.vertices[:, axis]
    if mesh.colors is not None:
        for name, channel in zip(("red", "green", "blue"), _bytes(mesh.colors).T, strict=True):
            rows[name] = channel
    faces = np.empty(len(mesh.faces), [("length", "u1"), ("indices", "<i4", (3,))])
    faces["length"], faces["indices"] = 3, mesh.faces
    names = {"<f8": "double", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {names[kind]} {name}" for name, kind in fields]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    stream.write("\n".join(header).encode())
    stream.write(rows.tobytes())
    stream.write(faces.tobytes())
    return []


def _write_obj(mesh: Mesh, stream: BinaryIO) -> list[str]:
    rows = mesh.vertices if mesh.colors is None else np.hstack([mesh.vertices, mesh.colors])
    _write_lines(stream, "v " + _numbers(rows), rows)
    _write_lines(stream, "f %d %d %d", mesh.faces + 1)
    return []


def _write_off(mesh: Mesh, stream: BinaryIO) -> list[str]:
    colored = mesh.colors is not None
    stream.write(f"{'COFF' if colored else 'OFF'}\n{len(mesh.vertices)} {len(mesh.faces)} 0\n".encode())
    if mesh.colors is None:
        _write_lines(stream, _numbers(mesh.vertices), mesh.vertices)
    else:  # red, green, blue, alpha
        rows = np.hstack([mesh.vertices, _bytes(mesh.colors), np.full((len(mesh.vertices), 1), 255)])
        _write_lines(stream, _numbers(mesh.vertices) + " %d %d %d %d", rows)
    _write_lines(stream, "3 %d %d %d", mesh.faces)
    return []


def _numbers(rows: Rows) -> str:
    """Coordinates with nine digits beyond what the mesh's size needs at its place; colors with four."""
    size = max(float(np.abs(rows[:, :3]).max(initial=0)), 1e-300)
    extent = max(float(np.ptp(rows[:, :3], axis=0).max(initial=0)) if len(rows) else 0.0, 1e-300)
    digits = int(np.clip(9 + np.ceil(np.log10(size / extent)), 9, 17))
    return " ".join([f"%.{digits}g"] * 3 + ["%.4g"] * (rows.shape[1] - 3))


def _write_lines(stream: BinaryIO, form: str, rows: Rows) -> None:
    for start in range(0, len(rows), 100_000):  # one formatting call for many rows is ten times as fast as np.savetxt
        part = rows[start : start + 100_000]
        stream.write((f"{form}\n" * len(part) % tuple(part.ravel().tolist())).encode())


def _check_single_precision(mesh: Mesh, format: str) -> None:
    largest = np.abs(mesh.vertices).max(initial=0)
    if largest > np.finfo(np.float32).max:
        raise InputError(
            f"coordinates as large as {largest:.3g} do not fit the single precision of {format}; write .ply"
        )


def _write_stl(mesh: Mesh, stream: BinaryIO) -> list[str]:
    _check_single_precision(mesh, "STL")
    area = mesh.area_vectors()
    length = np.linalg.norm(area, axis=1, keepdims=True)
    rows = np.zeros(len(mesh.faces), [("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    rows["normal"] = area / np.where(length > 0, length, 1)
    rows["corners"] = mesh.vertices[mesh.faces]
    stream.write(b"binary STL".ljust(80) + np.uint32(len(rows)).tobytes())
    stream.write(rows.tobytes())
    warnings = ["STL has no colors; choose .ply, .obj, .off or .glb to keep them"] if mesh.colors is not None else []
    error = float(np.abs(mesh.vertices - mesh.vertices.astype(np.float32)).max(initial=0))
    if error > SINGLE_PRECISION_LOSS * float(np.ptp(mesh.vertices, axis=0).max(initial=0)):
        warnings.append(f"STL has single precision: coordinates are off by up to {error:.2g}; choose .ply or .obj")
    return warnings


def gltf_offset(mesh: Mesh) -> NDArray[np.float64] | None:
    """Find what `write_mesh` takes off coordinates for glTF, whose viewers have single precision; None for nothing."""
    low, high = mesh.vertices.min(axis=0, initial=np.inf), mesh.vertices.max(axis=0, initial=-np.inf)
    middle = (low + high) / 2
    far = len(mesh.vertices) and np.abs(middle).max() > FAR * float((high - low).max())
    return np.asarray(np.round(middle)) if far else None


def _write_glb(mesh: Mesh, stream: BinaryIO) -> list[str]:
    """glTF 2.0, binary: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html

    In glTF y is up. The cloud's z, which is up in most of them, becomes y here, and is z again when the file is read.
    """
    _check_single_precision(mesh, "glTF")
    offset = gltf_offset(mesh)
    vertices = mesh.vertices if offset is None else mesh.vertices - offset
    origin = (vertices.min(axis=0) + vertices.max(axis=0)) / 2 if len(vertices) else np.zeros(3)
    arrays = {
        "POSITION": to_y_up(vertices - origin).astype("<f4"),
        "NORMAL": to_y_up(mesh.vertex_normals()).astype("<f4"),
    }
    if mesh.colors is not None:
        arrays["COLOR_0"] = np.pad(to_light(mesh.colors), ((0, 0), (0, 1)), constant_values=1).astype("<f4")
    arrays["indices"] = mesh.faces.astype("<u4").reshape(-1, 1)
    views, accessors, end = _gltf_layout(arrays)
    *attributes, indices = range(len(arrays))
    primitive = {"attributes": dict(zip(arrays, attributes, strict=False)), "indices": indices, "material": 0}
    extras = {} if offset is None else {"extras": {OFFSET: offset.tolist()}}
    document = {
        "asset": {"version": "2.0", "generator": "jetnormal"} | extras,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": to_y_up(origin[None])[0].tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"doubleSided": True, "pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0.8}}],
        "buffers": [{"byteLength": end}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    sizes = np.array([len(text), end], "<u4")
    stream.write(b"glTF" + np.array([2, 28 + sizes.sum()], "<u4").tobytes())
    stream.write(sizes[:1].tobytes() + b"JSON" + text + sizes[1:].tobytes() + b"BIN\0")
    for array in arrays.values():
        stream.write(array.tobytes())
    if offset is None:
        return []
    return [
        f"glTF has single precision: {offset.tolist()} is taken off the coordinates and stands in the file's extras"
    ]


def _gltf_layout(arrays: dict[str, NDArray[Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]], int]:
    """Where arrays lie in one buffer, one after the other: its views, the accessors, and its length in bytes."""
    kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    end = 0  # of the buffer
    for name, array in arrays.items():
        view = {"buffer": 0, "byteOffset": end, "byteLength": array.nbytes}
        accessor = {
            "bufferView": len(views),
            "componentType": 5125 if name == "indices" else 5126,  # uint32, float32
            "count": len(array),
            "type": kinds[array.shape[1]],
        }
        if name == "POSITION":
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        views.append(view)
        accessors.append(accessor)
        end += array.nbytes
    return views, accessors, end


_WRITERS: dict[str, Callable[[Mesh, BinaryIO], list[str]]] = {
    ".ply": _write_ply,
    ".obj": _write_obj,
    ".stl": _write_stl,
    ".off": _write_off,
    ".glb": _write_glb,
}
MESH_SUFFIXES = tuple(READERS)
