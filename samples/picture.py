"""Draw a point cloud with normals: as scanned, colored by its normals, and lit by them.

    python samples/picture.py scan_normals.ply scan_normals.png --up=0,-1,0 --front=0.5,-0.3,-1

Every point becomes a small disk, and the nearest one wins. In the last panel a wrong sign shows as a
dark spot.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import jetnormal

SIZE = 900  # pixels of a panel's longer side
OVERSAMPLING = 2  # rendered that much larger and averaged, against jagged edges
BACKGROUND = np.array([0.09, 0.10, 0.12])
CLAY = np.array([0.88, 0.84, 0.78])


def camera_axes(front: NDArray[np.float64], up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows: right, up and towards the camera, for a camera that stands in direction `front` of the cloud."""
    towards = front / np.linalg.norm(front)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def pixel_positions(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Scale (N, 3) camera coordinates to pixels from the upper left corner; also return pixels per unit."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    scale = 0.92 * SIZE * OVERSAMPLING / float((high - low).max())
    margin = 0.04 * SIZE * OVERSAMPLING
    pixels = (points[:, :2] - low) * scale + margin
    pixels[:, 1] = (high - low)[1] * scale + 2 * margin - pixels[:, 1]  # rows grow downwards
    return pixels, scale


def visible_points(points: NDArray[np.float64], spacing: float) -> NDArray[np.int64]:
    """Splat (N, 3) camera coordinates as disks; return per pixel the index of the point on top, or -1."""
    pixels, scale = pixel_positions(points)
    radius = max(1, round(0.8 * spacing * scale))
    width, height = (np.ceil(pixels.max(axis=0)).astype(int) + round(0.04 * SIZE * OVERSAMPLING)).tolist()
    offsets = np.stack(np.meshgrid(*[np.arange(-radius, radius + 1)] * 2), axis=-1).reshape(-1, 2)
    offsets = offsets[(offsets**2).sum(axis=1) <= radius**2]
    far_to_near = np.argsort(points[:, 2], kind="stable")
    covered = pixels[far_to_near].astype(int)[:, None] + offsets  # (N, disk, 2)
    column, row = np.clip(covered, 0, [width - 1, height - 1]).reshape(-1, 2).T
    index = np.full((height, width), -1)
    index[row, column] = np.repeat(far_to_near, len(offsets))  # the last point written to a pixel stays
    return index


def paint(index: NDArray[np.int64], colors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Give each pixel the color of its point, and average the oversampled pixels."""
    image = np.where(index[..., None] >= 0, colors[index], BACKGROUND)
    height, width = (length // OVERSAMPLING for length in index.shape)
    image = image[: height * OVERSAMPLING, : width * OVERSAMPLING]
    return image.reshape(height, OVERSAMPLING, width, OVERSAMPLING, 3).mean(axis=(1, 3))


def file_colors(cloud: jetnormal.Cloud) -> NDArray[np.float64]:
    """The cloud's own colors, from 0 to 1, or clay where it has none."""
    channels = [cloud.attributes.get(name) for name in ("red", "green", "blue")]
    if any(channel is None for channel in channels):
        return np.tile(CLAY, (len(cloud), 1))
    return np.stack([np.asarray(channel) for channel in channels], axis=1) / 255


def lit(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Clay under a lamp at the upper left and a fainter one at the right; (N, 3) camera coordinates."""
    key = np.clip(normals @ [-0.48, 0.48, 0.74], 0, 1)
    fill = np.clip(normals @ [0.78, 0.0, 0.62], 0, 1)
    return np.clip((0.08 + 0.75 * key + 0.40 * fill)[:, None] * CLAY, 0, 1)


def draw(cloud: jetnormal.Cloud, axes: NDArray[np.float64], output: Path) -> None:
    """Write the three panels side by side as a PNG."""
    from matplotlib.figure import Figure
    from scipy.spatial import cKDTree

    if cloud.normals is None:
        raise SystemExit("the cloud has no normals: run `jetnormal estimate` first")
    valid = cloud.valid & np.isfinite(cloud.normals).all(axis=1)
    points, normals = cloud.points[valid] @ axes.T, cloud.normals[valid] @ axes.T
    spacing = float(np.median(cKDTree(points).query(points, k=5)[0][:, -1]))
    index = visible_points(points, spacing)
    panels = {
        "as scanned": file_colors(cloud)[valid],
        "normals as colors": 0.5 + 0.5 * normals,
        "lit by the normals": lit(normals),
    }
    height, width = (length // OVERSAMPLING for length in index.shape)
    figure = Figure(figsize=(3 * width / 150, (height + 60) / 150), dpi=150, facecolor=tuple(BACKGROUND))
    for place, (title, colors) in enumerate(panels.items()):
        panel = figure.add_axes((place / 3, 0, 1 / 3, height / (height + 60)))
        panel.imshow(paint(index, colors))
        panel.set_axis_off()
        panel.set_title(title, color="white", fontsize=11)
    figure.savefig(output, facecolor=figure.get_facecolor())


def vector(text: str) -> NDArray[np.float64]:
    return np.array([float(part) for part in text.split(",")])


def main() -> None:
    parser = argparse.ArgumentParser(description="Draw a point cloud with normals as a PNG.")
    parser.add_argument("cloud", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--up", type=vector, default=vector("0,0,1"), help="upwards, as X,Y,Z")
    parser.add_argument("--front", type=vector, default=vector("1,-1,0.6"), help="towards the camera")
    arguments = parser.parse_args()
    draw(jetnormal.read(arguments.cloud), camera_axes(arguments.front, arguments.up), arguments.output)
    print(f"picture: {arguments.output}")


if __name__ == "__main__":
    main()
