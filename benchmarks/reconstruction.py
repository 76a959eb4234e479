"""Meshes from estimated normals beside meshes from the true ones: Chamfer distance and normal consistency.

    python benchmarks/reconstruction.py --data validation --meshes meshes [--model jet --model deepfit-small]
        [--category none --category low] [--points 100000] [--results reconstruction.jsonl]

For every cloud in PCPNet's layout, Poisson surfaces with the options of `jetnormal reconstruct` come from

    true            the true normals
    open3d          Open3D's PCA (k = 30) and its orientation on tangent planes (k = 30), if done within 120 s
    each --model    `jetnormal.estimate`, oriented as it does by default

and are compared with the true mesh, MESHES/SHAPE.npz (or .ply .obj .off .stl), whose name begins the cloud's, by the
experiment of the surface-fitting literature: 100,000 samples of each surface and the L2 Chamfer distance, here times
10^4 with the longest side of the true mesh's box at 1. "surface" is what two samples of the true mesh have.
With --results, a run goes on where the last one stopped. Estimates of large clouds by networks take minutes each.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jetnormal
from jetnormal.cloud import Cloud
from jetnormal.data.mesh_sampler import MeshSampler, load_mesh
from jetnormal.errors import JetnormalError
from jetnormal.formats import pcpnet
from jetnormal.formats.meshes import MESH_SUFFIXES
from jetnormal.mesh import Mesh
from jetnormal.meshing.distances import surface_distance

SAMPLES = 100_000
OPEN3D_K = 30
OPEN3D_SECONDS = 120
CHAMFER_UNIT = 1e-4


def find_mesh(folder: Path, shape: str) -> Mesh:
    for suffix in MESH_SUFFIXES:
        if (folder / f"{shape}{suffix}").is_file():
            return load_mesh(folder / f"{shape}{suffix}")
    raise SystemExit(f"{folder}: holds no mesh of {shape} ({' '.join(MESH_SUFFIXES)})")


def open3d_normals(points: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """PCA and tangent-plane orientation in a child, for on some clouds it does not end; None then."""
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder, "points.npy"), points)
        try:
            subprocess.run([sys.executable, __file__, "--child", folder], check=True, timeout=OPEN3D_SECONDS)
        except (subprocess.TimeoutExpired, subprocess.CalledProcessError):
            return None
        return np.load(Path(folder, "normals.npy"))


def open3d_child(folder: Path) -> None:
    from jetnormal.support.open3d_loader import import_open3d

    open3d: Any = import_open3d()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.load(folder / "points.npy")))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(OPEN3D_K))
    cloud.orient_normals_consistent_tangent_plane(OPEN3D_K)
    np.save(folder / "normals.npy", np.asarray(cloud.normals))


def outward(points: NDArray[np.float64], normals: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Share of normals on the side of the true ones."""
    return float(np.mean((normals * true).sum(axis=1) > 0))


def measure(
    method: str, points: NDArray[np.float64], true: NDArray[np.float64], mesh: Mesh, depth: int | None, seed: int
) -> dict[str, Any]:
    """One row of the results: the mesh that a method's normals give, against the true one."""
    rng = np.random.default_rng(seed)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    sampler = MeshSampler(Mesh(mesh.vertices / size, mesh.faces))
    target = sampler.sample(SAMPLES, rng)
    start = time.perf_counter()
    row: dict[str, Any] = {}
    if method == "surface":
        sample = sampler.sample(SAMPLES, rng)
    else:
        normals = (
            true if method == "true"
            else open3d_normals(points) if method == "open3d"
            else jetnormal.estimate(points, model=method)
        )  # fmt: skip
        if normals is None:
            return {"failed": f"no orientation within {OPEN3D_SECONDS} s"}
        try:
            found = jetnormal.reconstruct(Cloud(points, normals), depth=depth)
        except JetnormalError as error:
            return {"failed": str(error)}
        row = {"outward": outward(points, normals, true), "faces": len(found.faces)}
        sample = MeshSampler(Mesh(found.vertices / size, found.faces)).sample(SAMPLES, rng)
    row["seconds"] = round(time.perf_counter() - start, 2)
    return row | surface_distance(sample, target)._asdict()


def tables(rows: list[dict[str, Any]], methods: list[str]) -> str:
    """Means by category, in Markdown; the number of clouds that a method failed on in brackets."""
    categories = [name for name in pcpnet.CATEGORIES if any(row["category"] == name for row in rows)]
    text = []
    for title, key, unit in (
        ("L2 Chamfer distance x 10^4", "chamfer", CHAMFER_UNIT),
        ("normal consistency", "normal_consistency", 1),
        ("share of normals that point outward", "outward", 1),
    ):
        text += [f"\n| {title} | " + " | ".join(methods) + " |", "|---" * (len(methods) + 1) + "|"]
        for category in [*categories, "average"]:
            cells = []
            for method in methods:
                own = [row for row in rows if row["method"] == method and category in ("average", row["category"])]
                values = [row[key] / unit for row in own if key in row]
                failed = sum("failed" in row for row in own)
                cells.append((f"{np.mean(values):.4f}" if values else "") + (f" ({failed} failed)" if failed else ""))
            text.append(f"| {category} | " + " | ".join(cells) + " |")
    return "\n".join(text)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder of clouds in PCPNet's layout")
    parser.add_argument("--meshes", type=Path, help="folder of the true meshes")
    parser.add_argument("--model", action="append", default=[], help="repeatable; as in jetnormal estimate")
    parser.add_argument("--category", action="append", choices=list(pcpnet.CATEGORIES), help="repeatable")
    parser.add_argument("--shape", action="append", help="repeatable; the beginning of a shape's name")
    parser.add_argument("--points", type=int, default=100_000, help="of each cloud, at random if it has more")
    parser.add_argument("--depth", type=int, help="of Poisson's octree; by default that of jetnormal reconstruct")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--results", type=Path, help="JSON lines, one per cloud and method; existing ones count")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        open3d_child(arguments.child)
        return
    if arguments.data is None or arguments.meshes is None:
        parser.error("--data and --meshes are needed")
    methods = ["surface", "true", "open3d", *arguments.model]
    rows = []
    if arguments.results and arguments.results.is_file():
        rows = [json.loads(line) for line in arguments.results.read_text().splitlines()]
    done = {(row["cloud"], row["method"]) for row in rows}
    for name in pcpnet.cloud_names(arguments.data, None):
        shape, category = pcpnet.split_name(name)
        wanted = not arguments.shape or any(shape.startswith(start) for start in arguments.shape)
        missing = [method for method in methods if (name, method) not in done]
        if not missing or not wanted or category not in (arguments.category or pcpnet.CATEGORIES):
            continue
        points, normals, _ = pcpnet.read_cloud(arguments.data, name)
        rng = np.random.default_rng(arguments.seed)
        keep = np.sort(rng.permutation(len(points))[: arguments.points])
        mesh = find_mesh(arguments.meshes, shape)
        for method in missing:
            row = {"cloud": name, "category": category, "method": method}
            row |= measure(method, points[keep], normals[keep], mesh, arguments.depth, arguments.seed)
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
            if arguments.results:
                with arguments.results.open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
    print(tables(rows, methods))


if __name__ == "__main__":
    main()
