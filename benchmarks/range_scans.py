"""Models on real range scans of an object, each view alone and all together; the mesh made of them is the reference.

    python benchmarks/range_scans.py bunny/data/bun.conf bunny/reconstruction/bun_zipper.ply

The layout is that of the Stanford 3D Scanning Repository: a `.conf` file with a line "bmesh FILE x y z qx qy qz qw" for
each view. Points near the mesh are evaluated; the mesh's normal at the nearest place is the true one. The mesh is
smoother than a view, so a method that smooths has an advantage.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import jetnormal
from jetnormal.data.mesh_sampler import load_mesh
from jetnormal.geometry.metrics import angles, oriented_accuracy, rmse
from jetnormal.geometry.vectors import unit
from jetnormal.mesh import Mesh
from jetnormal.support.open3d_loader import require_open3d

MODELS = ["pca:k=30", "pca:k=112", "jet:k=30,order=2", "jet:k=60,order=2", "cloudfit"]
WITHIN = 0.003  # of the mesh's diagonal: what is farther away does not belong to it
Floats = NDArray[np.float64]


class Reference:
    """A mesh with interpolated vertex normals."""

    def __init__(self, mesh: Mesh) -> None:
        open3d = require_open3d("finds the nearest point of a mesh")
        self._tensor = open3d.core.Tensor
        self._faces = mesh.faces
        self._normals = mesh.vertex_normals()
        self.within = WITHIN * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        self._scene = open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(mesh.vertices.astype(np.float32)), self._tensor(mesh.faces.astype(np.uint32))
        )

    def nearest(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances (N,) of points (N, 3) from the mesh, and its outward unit normals (N, 3) there."""
        found = self._scene.compute_closest_points(self._tensor(points.astype(np.float32)))
        distance = np.linalg.norm(found["points"].numpy() - points, axis=1)
        weights = found["primitive_uvs"].numpy().astype(np.float64)
        weights = np.column_stack([1 - weights.sum(1), weights])
        corners = self._normals[self._faces[found["primitive_ids"].numpy().astype(np.int64)]]
        return distance, unit((corners * weights[..., None]).sum(1))


def read_views(configuration: Path, reference: Reference) -> list[Floats]:
    """The views of a .conf file, (N, 3) each, in one frame.

    Files differ in the sign of qw; for each view the one is taken that brings it nearer to the mesh.
    """
    views = []
    for line in configuration.read_text().splitlines():
        if not line.startswith("bmesh"):
            continue
        _, name, *numbers = line.split()
        *shift, x, y, z, w = map(float, numbers)
        points = jetnormal.read(configuration.parent / name).points
        turned = [points @ Rotation.from_quat([x, y, z, sign * w]).as_matrix().T + shift for sign in (1, -1)]
        views.append(min(turned, key=lambda placed: float(np.median(reference.nearest(placed)[0]))))
    return views


def measure(model: str, views: list[Floats], references: list[tuple[Floats, Floats]], within: float) -> list[str]:
    """Cells of the table: errors of the points nearer to the mesh than `within`, and the share of signs that are right.

    Args:
        model: as in `jetnormal.estimate`.
        views: clouds (N, 3).
        references: `Reference.nearest` of each.
        within: in the unit of the clouds.
    """
    found, true = [], []
    for points, (distance, normals) in zip(views, references, strict=True):
        near = distance < within
        found.append(jetnormal.estimate(points, model=model)[near])
        true.append(normals[near])
    estimated, expected = np.concatenate(found), np.concatenate(true)
    errors, (right, _) = angles(estimated, expected), oriented_accuracy(estimated, expected)
    return [f"{rmse(errors):.2f}", f"{np.median(errors):.2f}", f"{(errors > 30).mean():.1%}", f"{right:.1%}"]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configuration", type=Path, help=".conf file of the views")
    parser.add_argument("mesh", type=Path, help="mesh made of them")
    parser.add_argument("--model", action="append", help=f"default: {' '.join(MODELS)}")
    options = parser.parse_args()
    reference = Reference(load_mesh(options.mesh))
    views = read_views(options.configuration, reference)
    references = [reference.nearest(points) for points in views]
    merged = [np.concatenate(views)]
    distances, normals = zip(*references, strict=True)
    merged_reference = [(np.concatenate(distances), np.concatenate(normals))]
    print(f"{options.configuration.name}: {len(views)} views, {len(merged[0]):,} points\n")
    columns = " | ".join(["RMSE", "median", "over 30°", "right signs"])
    print(f"| model | views alone: {columns} | merged: {columns} |")
    print("|---" * 9 + "|")
    for model in options.model or MODELS:
        alone = measure(model, views, references, reference.within)
        together = measure(model, merged, merged_reference, reference.within)
        print(f"| {model} | {' | '.join(alone + together)} |", flush=True)


if __name__ == "__main__":
    main()
