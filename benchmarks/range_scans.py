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
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.vectors import unit
from jetnormal.mesh import Mesh
from jetnormal.support.open3d_loader import require_open3d

MODELS = ["pca:k=30", "pca:k=112", "jet:k=30,order=2", "jet:k=60,order=2", "deepfit-small", "cloudfit"]
WITHIN = 0.003  # of the mesh's diagonal: what is farther away does not belong to it
Floats = NDArray[np.float64]


class Reference:
    """A mesh with interpolated vertex normals."""

    def __init__(self, mesh: Mesh) -> None:
        open3d = require_open3d("finds the nearest point of a mesh")
        self._tensor = open3d.core.Tensor
        self._faces = mesh.faces
        self._normals = np.zeros_like(mesh.vertices)
        for corner in mesh.faces.T:
            np.add.at(self._normals, corner, mesh.area_vectors())
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


def measure(model: str, views: list[Floats], reference: Reference) -> tuple[NDArray[np.float64], float]:
    """Errors in degrees of all points near the mesh, and the share of their signs that are right."""
    errors, outward = [], []
    for points in views:
        distance, true = reference.nearest(points)
        near = distance < reference.within
        normals = jetnormal.estimate(points, model=model)[near]
        errors.append(angles(normals, true[near]))
        outward.append((normals * true[near]).sum(1) > 0)
    return np.concatenate(errors), float(np.concatenate(outward).mean())


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configuration", type=Path, help=".conf file of the views")
    parser.add_argument("mesh", type=Path, help="mesh made of them")
    parser.add_argument("--model", action="append", help=f"default: {' '.join(MODELS)}")
    options = parser.parse_args()
    reference = Reference(load_mesh(options.mesh))
    views = read_views(options.configuration, reference)
    merged = [np.concatenate(views)]
    print(f"{options.configuration.name}: {len(views)} views, {len(merged[0]):,} points\n")
    columns = " | ".join(["RMSE", "median", "over 30°", "right signs"])
    print(f"| model | views alone: {columns} | merged: {columns} |")
    print("|---" * 9 + "|")
    for model in options.model or MODELS:
        cells = []
        for clouds in (views, merged):
            errors, outward = measure(model, clouds, reference)
            cells += [f"{rmse(errors):.2f}", f"{np.median(errors):.2f}"]
            cells += [f"{share:.1%}" for share in ((errors > 30).mean(), outward)]
        print(f"| {model} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
