"""How each mesh format is read; `formats.meshes` checks what comes out.

PLY goes through the codec of clouds, whose errors name the line, and OFF, a table of vertices and one of faces, is read
here with its colors. OBJ, STL and glTF are trimesh's. All of it is Python and NumPy, so that a damaged file
raises an exception; Open3D's readers may crash on one.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, ResourceError
from jetnormal.formats import ply
from jetnormal.formats.npz import load_arrays
from jetnormal.formats.ply_faces import polygons_of
from jetnormal.mesh import Mesh

Rows = NDArray[Any]
CHANNELS = ("red", "green", "blue")
OFFSET = "jetnormal_offset"  # in the extras of a glTF asset: what was taken off its coordinates, in the cloud's axes
_GLB_HEADER = 20  # bytes before the JSON of a .glb file


def read_npz(path: Path) -> Mesh:
    """Read the arrays `vertices` and `faces`."""
    vertices, faces = load_arrays(path, "vertices", "faces")
    if vertices.dtype.kind not in "iuf" or faces.dtype.kind not in "iu":
        raise InputError(f"{path}: vertices are {vertices.dtype} and faces {faces.dtype}, not numbers and integers")
    return Mesh(vertices.astype(np.float64), faces.astype(np.int64))


def read_ply(path: Path) -> Mesh:
    """Read the vertices and the element `face` of a PLY file."""
    cloud = ply.read(path)
    polygons = polygons_of(cloud.source.extra, path)
    colors = None
    if all(name in cloud.attributes for name in CHANNELS):
        colors = _unit_range(np.stack([cloud.attributes[name] for name in CHANNELS], axis=1))
    return Mesh(cloud.points, fans(polygons), colors)


def read_off(path: Path) -> Mesh:
    """Read an OFF or COFF file: two tables of text."""
    lines = _words(path)
    try:
        title = next(lines)
        if title[0] not in (b"OFF", b"COFF"):
            raise ValueError("the first line is neither OFF nor COFF")
        vertices, faces = (int(word) for word in (title[1:] or next(lines))[:2])
        if min(vertices, faces) < 0 or vertices + faces > path.stat().st_size:
            raise ValueError(f"{vertices} vertices and {faces} faces do not fit into the file")
        rows = [[float(word) for word in next(lines)] for _ in range(vertices)]
        polygons = [_off_face(next(lines)) for _ in range(faces)]
    except StopIteration:
        raise InputError(f"{path}: ends before its last face; the file is truncated") from None
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: damaged OFF file ({error}); export it again") from None
    if max((max(polygon, default=0) for polygon in polygons), default=0) >= vertices:
        raise InputError(f"{path}: a face names a vertex that does not exist (there are {vertices})")
    columns = {len(row) for row in rows}
    if len(columns) != 1 or min(columns) < 3:
        raise InputError(f"{path}: its vertices do not have the same number of values, three or more")
    table = np.array(rows)
    colored = title[0] == b"COFF" and table.shape[1] >= 6
    colors = _unit_range(_integers_if_beyond_one(table[:, 3:6])) if colored else None
    return Mesh(table[:, :3].copy(), fans(polygons), colors)


def read_with_trimesh(path: Path) -> Mesh:
    """Read an OBJ or STL file, or the default scene of a glTF file, all its meshes as one.

    trimesh says in exceptions of many kinds that a file is damaged.
    """
    suffix = path.suffix.lower()
    try:
        return _read_gltf(path) if suffix in (".glb", ".gltf") else _read_geometry(path)
    except (InputError, ResourceError):
        raise
    except MemoryError as error:
        raise ResourceError(f"{path}: does not fit into memory; use a smaller mesh") from error
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(f"{path}: damaged or not a {suffix} file ({reason}); export it again") from error


READERS: dict[str, Callable[[Path], Mesh]] = {
    ".npz": read_npz,
    ".ply": read_ply,
    ".off": read_off,
    ".obj": read_with_trimesh,
    ".stl": read_with_trimesh,
    ".glb": read_with_trimesh,
    ".gltf": read_with_trimesh,
}


def fans(polygons: Sequence[Any] | Rows) -> NDArray[np.int64]:
    """Cut polygons into triangles (F, 3) around their first corner, in their order; what has no area is dropped.

    Args:
        polygons: an array (F, n) of corners, or a sequence of F arrays (n,).
    """
    if isinstance(polygons, np.ndarray) and polygons.ndim == 2:
        return _fan(polygons.astype(np.int64))
    lengths = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    parts, places = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for length in np.unique(lengths[lengths > 2]):
        rows = np.flatnonzero(lengths == length)
        parts.append(_fan(np.array([polygons[row] for row in rows.tolist()], dtype=np.int64)))
        places.append(np.repeat(rows, length - 2))
    return np.concatenate(parts)[np.argsort(np.concatenate(places), kind="stable")]


def _fan(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Polygons (F, n) as triangles, (F * (n - 2), 3)."""
    steps = range(1, corners.shape[1] - 1)
    return np.stack([corners[:, [0, step, step + 1]] for step in steps], axis=1).reshape(-1, 3)


def _off_face(words: list[bytes]) -> list[int]:
    corners = [int(word) for word in words[1 : int(words[0]) + 1]]
    if min(corners, default=0) < 0:
        raise ValueError("a face names a negative vertex")
    if len(corners) != int(words[0]):
        raise ValueError(f"a face of {int(words[0])} corners names {len(corners)}")
    return corners


def _words(path: Path) -> Iterator[list[bytes]]:
    """The words of each line that has any, without comments."""
    with path.open("rb") as stream:
        for line in stream:
            words = line.partition(b"#")[0].split()
            if words:
                yield words


def _integers_if_beyond_one(colors: Rows) -> Rows:
    """OFF writes colors as numbers up to 255 or up to 1."""
    return colors / 255 if colors.max(initial=0) > 1 else colors


def _unit_range(colors: Rows) -> NDArray[np.float64]:
    """Colors (V, 3) from 0 to 1, of integers that fill their type's range or of floats that are so already."""
    if colors.dtype.kind in "iu":
        return colors / float(np.iinfo(colors.dtype).max)
    return np.clip(np.nan_to_num(colors.astype(np.float64)), 0, 1)


def _read_geometry(path: Path) -> Mesh:
    from trimesh.exchange.obj import load_obj
    from trimesh.exchange.stl import load_stl

    with path.open("rb") as stream:
        if path.suffix.lower() == ".obj":
            found = load_obj(stream, skip_materials=True)
            return _joined([_part(part) for part in found.get("geometry", {"": found}).values() if "faces" in part])
        mesh = _part(load_stl(stream))
    # STL repeats each vertex in every face around it
    vertices, merged = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return Mesh(vertices, merged.reshape(-1)[mesh.faces])


def _read_gltf(path: Path) -> Mesh:
    from trimesh.exchange.gltf import load_glb, load_gltf
    from trimesh.resolvers import FilePathResolver
    from trimesh.scene.transforms import SceneGraph

    content = path.read_bytes()
    binary = path.suffix.lower() == ".glb"
    end = _GLB_HEADER + int.from_bytes(content[12:16], "little")
    document = _checked(content[_GLB_HEADER:end] if binary else content, path)
    load = load_glb if binary else load_gltf
    # from memory: of a file, Python would allocate as much as the header says that there is
    found = load(io.BytesIO(content), resolver=FilePathResolver(str(path)), skip_materials=True)
    graph = SceneGraph(base_frame=found.get("base_frame", "world"))
    for edge in found["graph"]:
        graph.update(**edge)
    meshes = []
    for node in graph.nodes_geometry:
        matrix, name = graph.get(node)
        if "faces" in found["geometry"][name]:
            meshes.append(_part(found["geometry"][name], matrix))
    joined = _joined(meshes)
    offset = np.array(document.get("asset", {}).get("extras", {}).get(OFFSET, [0, 0, 0]), dtype=np.float64)
    vertices = from_y_up(joined.vertices) + offset.reshape(1, 3)
    return Mesh(vertices, joined.faces, None if joined.colors is None else to_screen(joined.colors))


def _checked(text: bytes, path: Path) -> dict[str, Any]:
    """The JSON of a glTF file. Arrays that have a length but no content, zeros of any amount, are refused."""
    document: dict[str, Any] = json.loads(text)
    for accessor in document.get("accessors", []):
        if "bufferView" not in accessor:
            raise InputError(f"{path}: an array of it has no content (sparse or compressed glTF is not read)")
    return document


def to_y_up(vectors: Rows) -> Rows:
    """Turn vectors (N, 3) of a frame in which z is up into glTF's, in which y is."""
    return vectors[:, [0, 2, 1]] * [1, 1, -1]


def from_y_up(vectors: Rows) -> Rows:
    """Undo `to_y_up`."""
    return vectors[:, [0, 2, 1]] * [1, -1, 1]


def _part(found: dict[str, Any], matrix: Rows | None = None) -> Mesh:
    """A mesh of trimesh's arguments for one, turned by a matrix (4, 4); colors as they are in the file."""
    vertices = np.asarray(found["vertices"], dtype=np.float64)
    faces = fans(found["faces"])
    if matrix is not None:
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) < 0:  # a mirror image has the other winding
            faces = faces[:, ::-1]
    colors = found.get("vertex_colors")
    return Mesh(vertices, faces, None if colors is None else _unit_range(np.asarray(colors)[:, :3]))


def _joined(meshes: list[Mesh]) -> Mesh:
    """All in one, with colors if each has them."""
    if not meshes:
        return Mesh(np.empty((0, 3)), np.empty((0, 3), np.int64))
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    colors = [mesh.colors for mesh in meshes if mesh.colors is not None]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate(colors) if len(colors) == len(meshes) else None,
    )


def to_light(colors: Rows) -> Rows:
    """Convert screen colors (sRGB) to amounts of light, which glTF's are."""
    return np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)


def to_screen(light: Rows) -> Rows:
    """Undo `to_light`."""
    return np.where(light <= 0.0031308, light * 12.92, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)
