"""Signs of normals, with default options, by jetnormal's methods beside plain spanning trees and Open3D's.

    python benchmarks/orientation.py [FOLDER [--list LIST]] [--model deepfit-small --model jet:k=60 --model true ...]

All points of all clouds count that lie on a surface: of those of a folder in PCPNet's layout, or, without one, of
clouds that are made here (`made_clouds`), from solids with noise to scans, terrain, stray points and a million points.
For each model ("true": the true normals, with random signs), a table with a row for each category and a column for each
method: the share of right normals as they come, and after turning the whole cloud where that is better by more than
half a percent; and the seconds that the signs took. Open3D's, which may crash or not end, runs in a process of its own,
which is ended after --limit seconds; a category with such a cloud has no numbers.

A run that was interrupted goes on with the same --results.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jetnormal.formats.pcpnet import categorize, cloud_names, read_cloud

METHODS = ["auto", "global", "mst", "plain", "open3d"]
Row = dict[str, Any]  # model, cloud, category, method and result: what measure() returns, or None
NEIGHBORS = 12  # of a plain spanning tree, and of Open3D's
POINTS = 20_000  # of a cloud made here
SOLIDS, SCENES = 4, 3
STRAYS = 0.01  # of the points
FAR = 1e6  # diameters
OBJECTS = 30
SEED = 5
Cloud = tuple[np.ndarray, np.ndarray, np.ndarray]  # points (N, 3), true normals (N, 3), and which are on a surface (N,)


def made_clouds() -> Iterator[tuple[str, str, Cloud]]:
    """Make clouds with known normals, each with its name and category."""
    from jetnormal.data.benchmark_shapes import procedural_scene_shapes, solid_shapes
    from jetnormal.data.corruption import NOISE_LEVELS, add_noise
    from jetnormal.data.solids.draw import random_solid

    rng = np.random.default_rng(SEED)
    for scans in (False, True):
        for shape in solid_shapes(SOLIDS, scans):
            for cloud in shape.draw(POINTS, rng):
                labeled = np.ones(len(cloud.points), bool) if cloud.labeled is None else cloud.labeled
                category = f"scan: {cloud.category}" if scans else cloud.category
                yield cloud.name, category, (cloud.points, cloud.normals, labeled)
    for shape in procedural_scene_shapes(3 * SCENES, scans=True)[2::3]:  # rooms, streets and terrain take turns
        cloud = next(cloud for cloud in shape.draw(POINTS, rng) if cloud.name.endswith("airborne"))
        labeled = np.ones(len(cloud.points), bool) if cloud.labeled is None else cloud.labeled
        yield cloud.name, "airborne terrain", (cloud.points, cloud.normals, labeled)
    for number in range(SOLIDS):
        yield f"strays_{number}", "stray points", _with_strays(*random_solid(rng).sample(POINTS, rng), rng)
    yield "objects", "separate objects", _far_apart(rng)
    points, normals = random_solid(rng).sample(1_000_000, rng)
    yield (
        "million",
        "a million, medium noise",
        (add_noise(points, NOISE_LEVELS["medium"], rng), normals, np.ones(len(points), bool)),
    )


def _with_strays(points: np.ndarray, normals: np.ndarray, rng: np.random.Generator) -> Cloud:
    """Points, and some more at all distances up to FAR, in random directions."""
    count = round(STRAYS * len(points))
    directions = rng.normal(size=(2, count, 3))
    away, random = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    strays = away * np.linalg.norm(np.ptp(points, axis=0)) * FAR ** rng.uniform(size=(count, 1))
    on_surface = np.arange(len(points) + count) < len(points)
    return np.concatenate([points, strays]), np.concatenate([normals, random]), on_surface


def _far_apart(rng: np.random.Generator) -> Cloud:
    """Solids of all sizes, up to FAR apart."""
    from jetnormal.data.solids.draw import random_solid

    parts = []
    for _ in range(OBJECTS):
        points, normals = random_solid(rng).sample(POINTS // 10, rng)
        place = rng.normal(size=3) * 10 * FAR ** rng.uniform()
        parts.append((points * 10 ** rng.uniform(-1, 0) + place, normals))
    points, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return points, normals, np.ones(len(points), dtype=bool)


def plain_tree(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Hoppe et al., 1992: a spanning tree of 1 - |n.n'|, the highest point looking up."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import minimum_spanning_tree

    from jetnormal.geometry.neighbors import NeighborIndex
    from jetnormal.orientation.agreement import Forest, spread_signs

    n = len(points)
    neighbors = NeighborIndex(points).query(points, NEIGHBORS + 1)[0][:, 1:]
    dot = np.einsum("nd,nkd->nk", normals, normals[neighbors])
    weight = np.maximum(1 - np.abs(dot), 1e-9)
    graph = csr_matrix((weight.ravel(), neighbors.ravel(), np.arange(n + 1) * NEIGHBORS), (n, n))
    tree = minimum_spanning_tree(graph).tocoo()
    agreement = np.einsum("ed,ed->e", normals[tree.row], normals[tree.col])
    flips, component = spread_signs(Forest(tree.row, tree.col, agreement, n))
    normals = normals * np.where(flips, -1, 1)[:, None]
    order = np.lexsort((points[:, 2], component))
    top = order[np.append(np.flatnonzero(np.diff(component[order])), n - 1)]
    return normals * np.where(normals[top, 2] < 0, -1, 1)[component][:, None]


def open3d_plane(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    from jetnormal.support.open3d_loader import import_open3d

    open3d = import_open3d()
    if open3d is None:
        raise SystemExit("Open3D cannot be imported here")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    cloud.orient_normals_consistent_tangent_plane(NEIGHBORS)
    return np.asarray(cloud.normals)


def measure(method: str, file: Path) -> dict[str, float]:
    """Choose signs in this process, after a small cloud that pays for the imports."""
    from jetnormal.geometry.metrics import oriented_accuracy
    from jetnormal.orientation.policy import orient

    def run(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        if method == "plain":
            return plain_tree(points, normals)
        return open3d_plane(points, normals) if method == "open3d" else orient(points, normals, method)

    data = np.load(file)
    run(data["points"][:2000], data["normals"][:2000])
    start = time.perf_counter()
    normals = run(data["points"], data["normals"])
    seconds = time.perf_counter() - start
    labeled = data["labeled"]
    share, better = oriented_accuracy(normals[labeled], data["true"][labeled])
    return {"right": share, "better": better, "seconds": seconds}


def attempt(method: str, file: Path, limit: float) -> dict[str, float] | None:
    """Measure a method, Open3D in a child process; None if that crashes or takes too long."""
    if method != "open3d":
        return measure(method, file)
    command = [sys.executable, __file__, str(file), "--one", method]
    try:
        output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=limit).stdout
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        print(f"{file.stem}, {method}: {type(error).__name__}", file=sys.stderr)
        return None
    return json.loads(output.splitlines()[-1])


def attempts(
    name: str, methods: list[str], cloud: Cloud, normals: np.ndarray, limit: float
) -> Iterator[tuple[str, dict[str, float] | None]]:
    """Yield each method with what it reaches on a cloud whose normals were estimated."""
    points, true, labeled = cloud
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.npz"
        np.savez(file, points=points, normals=normals, true=true, labeled=labeled)
        for method in methods:
            yield method, attempt(method, file, limit)


def scrambled(normals: np.ndarray) -> np.ndarray:
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (len(normals), 1))
    return np.where(np.isfinite(normals), normals, 0).astype(np.float64) * signs


def print_table(model: str, rows: list[Row]) -> None:
    methods = list(dict.fromkeys(row["method"] for row in rows))
    print(f"\n{model}: right signs in % (after the better flip of the whole cloud, where that differs), seconds\n")
    print("| clouds | " + " | ".join(methods) + " |\n|---|" + "---|" * len(methods))
    for category in dict.fromkeys(row["category"] for row in rows):
        cells = []
        for method in methods:
            results = [row["result"] for row in rows if row["method"] == method and row["category"] == category]
            done = [result for result in results if result is not None]
            if not results:
                cells.append("")
                continue
            if len(done) < len(results):
                cells.append(f"{len(done)} of {len(results)} finished")
                continue
            mean = {key: 100 * np.mean([result[key] for result in done]) for key in done[0]}
            flipped = f" ({mean['better']:.2f})" if mean["better"] > mean["right"] + 0.5 else ""
            cells.append(f"{mean['right']:.2f}{flipped}, {mean['seconds'] / 100:.2f} s")
        print(f"| {category} | " + " | ".join(cells) + " |", flush=True)


def folder_clouds(folder: Path, list_file: str | None) -> Iterator[tuple[str, str, Cloud]]:
    """The clouds of a folder in PCPNet's layout, each with its name and category."""
    for name, category in categorize(folder, cloud_names(folder, list_file)).items():
        points, normals, _ = read_cloud(folder, name)
        yield name, category, (points, normals, np.isfinite(normals.sum(axis=1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--list", help="file in the folder that names clouds; without it, all")
    parser.add_argument("--model", action="append", help="repeatable; default: the default model")
    parser.add_argument("--method", action="append", choices=METHODS, help="repeatable; default: all")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds per cloud and method")
    parser.add_argument("--results", type=Path, help="JSON lines, one per model, cloud and method; existing ones count")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # what the child processes are asked for
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.folder)))
        return
    from jetnormal.estimators.factory import make_estimator
    from jetnormal.jobs.options import DEFAULT_MODEL

    methods = arguments.method or METHODS
    known: list[Row] = []
    if arguments.results and arguments.results.is_file():
        known = [json.loads(line) for line in arguments.results.read_text().splitlines()]
    for model in arguments.model or [DEFAULT_MODEL]:
        estimator = None if model == "true" else make_estimator(model)
        rows = []
        clouds = folder_clouds(arguments.folder, arguments.list) if arguments.folder else made_clouds()
        for name, category, (points, true, labeled) in clouds:
            about = {"model": model, "cloud": name, "category": category}
            mine = [row for row in known if (row["model"], row["cloud"]) == (model, name) and row["method"] in methods]
            rows += mine
            missing = [method for method in methods if method not in [row["method"] for row in mine]]
            if not missing:
                continue
            normals = scrambled(true if estimator is None else estimator(points).normals)
            for method, result in attempts(name, missing, (points, true, labeled), normals, arguments.limit):
                rows.append(about | {"method": method, "result": result})
                if arguments.results:
                    with arguments.results.open("a") as stream:
                        stream.write(json.dumps(rows[-1]) + "\n")
        print_table(model, rows)


if __name__ == "__main__":
    main()
