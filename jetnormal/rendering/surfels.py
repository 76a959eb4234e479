"""What a camera sees in each pixel: the place, the normal and the color of a surface.

Clouds are drawn as disks in their tangent planes that blend where they lie on one another (Zwicker et al., "Surface
splatting", 2001), meshes by casting rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.rendering.camera import Camera
from jetnormal.rendering.scene import Scene
from jetnormal.support.open3d_loader import require_open3d

Floats = NDArray[Any]  # float64, or float32 where there are many

DISK_RADIUS = 1.5  # in spacings of the points
LARGEST_DISK = 0.05  # of the picture's longer side, in radius: where points are sparser than that, gaps show
BLEND_DEPTH = 1.0  # in disk radii, behind the front, within which disks blend
STEEPEST = 0.2  # cosine between normal and line of sight from which on a disk is not drawn any narrower
TURNED_AWAY = 0.2  # cosine between normal and direction of sight above which a cloud shows its back
CHUNK_FRAGMENTS = 1_000_000  # drawn at a time: about 150 MB of working memory


@dataclass(frozen=True)
class Surfels:
    """(H, W) pixels, in the camera's frame.

    Attributes:
        depth: (H, W) float32, infinite where there is nothing.
        normals: (H, W, 3) float32 unit vectors, zero where unknown.
        colors: (H, W, 3) float32, from 0 to 1 (sRGB).
        back: (H, W) bool, where the inner side of a surface is seen.
        index: (H, W) int64, the point of a cloud, or the face of a mesh, that is in front; -1 where there is nothing.
    """

    depth: Floats
    normals: Floats
    colors: Floats
    back: NDArray[np.bool_]
    index: NDArray[np.int64]


def see(scene: Scene, camera: Camera) -> Surfels:
    """Find what the camera sees of a scene.

    Raises:
        ResourceError: the scene is a mesh, and Open3D is not there.
    """
    return _splat(scene, camera) if scene.faces is None else _cast(scene, camera)


@dataclass(frozen=True)
class _Disks:
    """Disks around the points of a cloud, in the camera's frame, and where their middles are in the picture."""

    normals: Floats
    pixels: Floats
    depth: Floats
    reach: NDArray[np.int64]  # in pixels
    radius: float


def _splat(scene: Scene, camera: Camera) -> Surfels:
    normals = camera.to_frame(scene.normals)
    pixels, depth = camera.project(camera.to_frame(scene.points))
    radius = DISK_RADIUS * spacing(scene.points)
    largest = LARGEST_DISK * max(camera.width, camera.height)
    reach = np.clip(camera.scale * radius / np.maximum(depth, 1e-12), 1, largest).astype(np.int64)
    disks = _Disks(normals, pixels, depth, reach, radius)
    inside = (depth > 0) & (pixels >= -reach[:, None]).all(axis=1)
    inside &= (pixels < [camera.width, camera.height] + reach[:, None]).all(axis=1)
    rows = np.flatnonzero(inside)
    chunks = list(_chunks(rows[np.argsort(pixels[rows, 1], kind="stable")], reach))
    count = camera.width * camera.height
    front = np.full(count, np.inf, dtype=np.float32)
    for rows, offsets in chunks:
        pixel, fragment_depth, _, _ = _fragments(disks, rows, offsets, camera)
        np.minimum.at(front, pixel, fragment_depth)
    values = np.concatenate([np.ones((len(depth), 1)), normals, scene.colors], axis=1).astype(np.float32)
    sums = np.zeros((7, count))
    index = np.full(count, -1)
    for rows, offsets in chunks:
        pixel, fragment_depth, weight, owner = _fragments(disks, rows, offsets, camera)
        foremost = fragment_depth == front[pixel]
        index[pixel[foremost]] = owner[foremost]
        seen = fragment_depth <= front[pixel] + BLEND_DEPTH * radius
        pixel, weight, owner = pixel[seen], weight[seen], owner[seen]
        if not len(pixel):
            continue
        band = slice(pixel.min(), pixel.max() + 1)  # narrow: the chunks go from top to bottom
        for channel in range(7):
            sums[channel, band] += np.bincount(pixel - band.start, weight * values[owner, channel])
    shape = (camera.height, camera.width)
    mean = (sums[1:] / np.where(sums[0] > 0, sums[0], 1)).T.reshape(*shape, 6).astype(np.float32)
    length = np.linalg.norm(mean[..., :3], axis=2, keepdims=True)
    unit = np.where(length > 1e-6, mean[..., :3] / np.where(length > 1e-6, length, 1), 0)
    sight = camera.rays() / np.linalg.norm(camera.rays(), axis=2, keepdims=True)
    back = (unit * sight).sum(axis=2) > TURNED_AWAY
    return Surfels(front.reshape(shape), unit, mean[..., 3:], back, index.reshape(shape))


def spacing(points: NDArray[np.float64]) -> float:
    """Estimate the distance between neighbors among points (N, 3); 1 if all are one point."""
    from jetnormal.geometry.neighbors import distinct, typical_spacing

    kept = points[distinct(points)[0]]
    return typical_spacing(kept) if len(kept) > 1 else 1.0


def _chunks(rows: NDArray[np.int64], reach: NDArray[np.int64]) -> Any:
    """Rows of points in chunks of one disk size, and the pixels (K, 2) of such a disk around its middle."""
    for size in np.unique(reach[rows]):
        grid = np.stack(np.meshgrid(*[np.arange(-size, size + 1)] * 2), axis=-1).reshape(-1, 2)
        grid = grid[(grid**2).sum(axis=1) <= (size + 0.5) ** 2]
        own = rows[reach[rows] == size]
        step = max(1, CHUNK_FRAGMENTS // len(grid))
        for start in range(0, len(own), step):
            yield own[start : start + step], grid


def _fragments(
    disks: _Disks, rows: NDArray[np.int64], offsets: NDArray[np.int64], camera: Camera
) -> tuple[NDArray[np.int64], Floats, Floats, NDArray[np.int64]]:
    """Pixel, depth, weight and point of each fragment (F,) of the disks of some points (R,) over offsets (K, 2)."""
    middle = np.floor(disks.pixels[rows])
    rest = (middle + 0.5 - disks.pixels[rows]).astype(np.float32)
    right, down = (rest[:, axis, None] + offsets[:, axis].astype(np.float32) for axis in range(2))  # (R, K)
    reach = disks.reach[rows, None].astype(np.float32)
    x, y, z = disks.normals[rows].astype(np.float32).T[:, :, None]
    # Along the tangent plane, a step to the right and down leads away from the camera by this, in pixels.
    sight = ((disks.pixels[rows] - camera.corner) / camera.scale).astype(np.float32)  # at depth 1
    facing = z - x * sight[:, :1] + y * sight[:, 1:]
    facing = np.where(np.abs(facing) > STEEPEST, facing, np.copysign(np.float32(STEEPEST), facing))
    deeper = (x * right - y * down) / facing
    squared = (right * right + down * down + deeper * deeper) / (reach * reach)
    across, along = (middle[:, axis, None].astype(np.int64) + offsets[:, axis] for axis in range(2))
    near = (right * right + down * down) <= 0.6  # of each disk, the pixel in the middle is drawn at any rate
    keep = (squared <= 1) | near
    keep &= (across >= 0) & (across < camera.width) & (along >= 0) & (along < camera.height)
    point, _ = np.nonzero(keep)
    owner = rows[point]
    unit = disks.depth[owner] / camera.scale  # of a pixel at the point
    depth = disks.depth[owner] + np.clip(deeper[keep] * unit, -disks.radius, disks.radius)
    pixel = along[keep] * camera.width + across[keep]
    return pixel, depth.astype(np.float32), np.exp(-3 * np.minimum(squared[keep], 1)), owner


def _cast(scene: Scene, camera: Camera) -> Surfels:
    open3d: Any = require_open3d("draws meshes")
    assert scene.faces is not None
    caster = open3d.t.geometry.RaycastingScene()
    vertices = camera.to_frame(scene.points).astype(np.float32)
    caster.add_triangles(
        open3d.core.Tensor.from_numpy(np.ascontiguousarray(vertices)),
        open3d.core.Tensor.from_numpy(scene.faces.astype(np.uint32)),
    )
    directions = camera.rays()
    rays = np.concatenate([np.broadcast_to([0, 0, camera.distance], directions.shape), directions], axis=2)
    hits = caster.cast_rays(open3d.core.Tensor.from_numpy(rays.astype(np.float32)))
    depth = hits["t_hit"].numpy()
    hit = np.isfinite(depth)
    index = np.where(hit, hits["primitive_ids"].numpy().astype(np.int64), -1)
    corners = scene.faces[index[hit]]
    u, v = hits["primitive_uvs"].numpy()[hit].T
    weights = np.stack([1 - u - v, u, v], axis=1)[:, None]
    normals, colors = (np.zeros((*depth.shape, 3), dtype=np.float32) for _ in range(2))
    back = hit & ((hits["primitive_normals"].numpy() * directions).sum(axis=2) > 0)
    mixed = (weights @ camera.to_frame(scene.normals)[corners])[:, 0]
    length = np.linalg.norm(mixed, axis=1, keepdims=True)
    normals[hit] = mixed / np.where(length > 0, length, 1)
    colors[hit] = (weights @ scene.colors[corners])[:, 0]
    return Surfels(depth, normals, colors, back, index)
