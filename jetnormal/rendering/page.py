"""A web page in one file, in which a cloud or a mesh turns; WebGL 2 and nothing else.

Places take 16 bits a coordinate, normals two bytes in octahedral coding (Meyer et al., "On floating-point normal
vectors", 2010), colors three and a confidence one. Clouds of more than 250,000 points are subsampled, meshes of more
than 180,000 faces simplified, so that a page stays below 5 MB.
"""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.geometry.vectors import unit
from jetnormal.rendering.camera import camera_axes, view_direction
from jetnormal.rendering.light import BACK_TINT, BACKGROUNDS, FILL, KEY
from jetnormal.rendering.scene import CLAY, SURE, UNSURE, Scene
from jetnormal.rendering.surfels import DISK_RADIUS, spacing
from jetnormal.support.open3d_loader import require_open3d

MAX_POINTS = 250_000
MAX_FACES = 180_000
SEED = 0


def encode_page(
    scene: Scene, title: str, view: str, background: str, *, max_points: int = MAX_POINTS, max_faces: int = MAX_FACES
) -> bytes:
    """Write a scene as a page, in UTF-8.

    Args:
        scene: what it shows.
        title: its title.
        view: from where it is seen at first (`rendering.camera.view_direction`).
        background: "white" or "dark".
        max_points: a larger cloud is subsampled.
        max_faces: a larger mesh is simplified.

    Raises:
        ResourceError: the scene is a mesh that must be simplified, and Open3D is not there.
    """
    shown = _counts(scene)
    turn = camera_axes(view_direction(view, scene.points, scene.normals)) @ scene.turn
    scene = scene.in_file_axes()  # normals are colored by them
    scene = _subsampled(scene, max_points) if scene.faces is None else _simplified(scene, max_faces)
    radius = max(float(np.linalg.norm(scene.points, axis=1).max()), 1e-12)
    parts = [
        np.round(scene.points / radius * 32767).astype("<i2"),
        encode_octahedral(scene.normals),
        _bytes(np.tile(CLAY, (len(scene.points), 1)) if scene.own is None else scene.own),
        _bytes(np.ones(len(scene.points)) if scene.confidence is None else scene.confidence),
    ]
    if scene.faces is not None:
        # indices begin at a multiple of 4 bytes only in a buffer of their own, which the page makes
        parts.append(scene.faces.astype("<u4"))
    meta = {
        "vertices": len(scene.points),
        "faces": 0 if scene.faces is None else len(scene.faces),
        "normals": bool(scene.normals.any()),
        "colorings": _colorings(scene),
        "coloring": scene.coloring,
        "shown": shown if _counts(scene) == shown else f"{shown}, {_counts(scene)} shown",
        "splat": DISK_RADIUS * spacing(scene.points) / radius if scene.faces is None else 0,
        "turn": turn.ravel().tolist(),
        "background": BACKGROUNDS[background],
        "clay": CLAY,
        "sure": SURE.tolist(),
        "unsure": UNSURE.tolist(),
    }
    red, green, blue = (round(255 * value) for value in BACKGROUNDS[background])
    fields = {
        "title": html.escape(title.encode("utf-8", "replace").decode()),  # names of files may be no text
        "background": f"rgb({red}, {green}, {blue})",
        "meta": json.dumps(meta).replace("</", "<\\/"),
        "lamp": _vec3(KEY),
        "fill": _vec3(FILL),
        "tint": _vec3(BACK_TINT**2.2),  # in amounts of light
        "data": base64.b64encode(b"".join(part.tobytes() for part in parts)).decode(),
    }
    page = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: fields[found[1]], page).encode()  # at once: a title may hold {{data}}


def encode_octahedral(normals: NDArray[np.float64]) -> NDArray[np.int8]:
    """Encode unit vectors (N, 3) as (N, 2) int8, to a degree: on an octahedron, whose lower half is folded up."""
    flat = normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-300)
    signs = np.where(flat[:, :2] < 0, -1, 1)
    folded = np.where(flat[:, 2:] < 0, (1 - np.abs(flat[:, 1::-1])) * signs, flat[:, :2])
    return np.round(folded * 127).astype(np.int8)


def _vec3(values: NDArray[np.float64]) -> str:
    """A constant of the shaders."""
    return f"vec3({', '.join(f'{value:.3f}' for value in values)})"


def _colorings(scene: Scene) -> list[str]:
    """What a scene can be colored by."""
    present = {
        "normals": scene.normals.any(),
        "file": scene.own is not None,
        "confidence": scene.confidence is not None,
    }
    return [*(name for name, there in present.items() if there), "plain"]


def _bytes(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    return np.round(np.clip(values, 0, 1) * 255).astype("u1")


def _counts(scene: Scene) -> str:
    if scene.faces is None:
        return f"{len(scene.points):,} points"
    return f"{len(scene.faces):,} faces"


def _subsampled(scene: Scene, count: int) -> Scene:
    if len(scene.points) <= count:
        return scene
    rows = np.sort(np.random.default_rng(SEED).permutation(len(scene.points))[:count])
    own = None if scene.own is None else scene.own[rows]
    confidence = None if scene.confidence is None else scene.confidence[rows]
    parts = scene.points[rows], scene.normals[rows], scene.colors[rows]
    return Scene(*parts, coloring=scene.coloring, own=own, confidence=confidence)


def _simplified(scene: Scene, count: int) -> Scene:
    """Simplify a mesh to `count` faces, if it has more (Garland and Heckbert, 1997)."""
    assert scene.faces is not None
    if len(scene.faces) <= count:
        return scene
    open3d: Any = require_open3d("simplifies meshes of this size")
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(scene.points), open3d.utility.Vector3iVector(scene.faces.astype(np.int32))
    )
    mesh.vertex_normals = open3d.utility.Vector3dVector(scene.normals)
    mesh.vertex_colors = open3d.utility.Vector3dVector(scene.colors if scene.own is None else scene.own)
    mesh = mesh.simplify_quadric_decimation(count)
    colors = np.asarray(mesh.vertex_colors)
    return Scene(
        np.asarray(mesh.vertices),
        unit(np.asarray(mesh.vertex_normals)),
        colors,
        np.asarray(mesh.triangles).astype(np.int64),
        coloring=scene.coloring,
        own=None if scene.own is None else colors,
    )
