"""Signs of normals on a benchmark in PCPNet's layout: jetnormal's methods beside plain spanning trees and Open3D's.

    python benchmarks/orientation.py FOLDER [--list LIST] [--model deepfit-small --model jet:k=60 --model true ...]

All points of all clouds count. For each model ("true": the true normals, with random signs) and method, a table by
category: the share of outward normals as they come; the share after turning the whole cloud if that is better; the
oriented RMSE, in degrees; and the seconds that the signs took. Each cloud and method runs in a process of its own,
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
from pathlib import Path
from typing import Any

import numpy as np

from jetnormal.formats.pcpnet import categorize, cloud_names, read_cloud

METHODS = ["global", "mst", "plain", "open3d"]
Row = dict[str, Any]  # model, cloud, category, method and result: what measure() returns, or None
NEIGHBORS = 12  # of a plain spanning tree, and of Open3D's


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
    """Chooses signs in this process, after a small cloud that pays for the imports."""
    from jetnormal.geometry.metrics import angles, oriented_accuracy, rmse
    from jetnormal.orientation.methods import orient

    def run(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        if method == "plain":
            return plain_tree(points, normals)
        return open3d_plane(points, normals) if method == "open3d" else orient(points, normals, method)

    data = np.load(file)
    run(data["points"][:2000], data["normals"][:2000])
    start = time.perf_counter()
    normals = run(data["points"], data["normals"])
    seconds = time.perf_counter() - start
    share, better = oriented_accuracy(normals, data["true"])
    error = rmse(angles(normals, data["true"], oriented=True))
    return {"outward": share, "better": better, "rmse": error, "seconds": seconds}


def attempt(method: str, file: Path, limit: float) -> dict[str, float] | None:
    """Measures in a child process; None if that crashes or takes too long."""
    command = [sys.executable, __file__, str(file), "--one", method]
    try:
        output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=limit).stdout
    except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
        print(f"{file.stem}, {method}: {type(error).__name__}", file=sys.stderr)
        return None
    return json.loads(output.splitlines()[-1])


def scrambled(normals: np.ndarray) -> np.ndarray:
    signs = np.random.default_rng(1).choice([-1.0, 1.0], (len(normals), 1))
    return np.where(np.isfinite(normals), normals, 0).astype(np.float64) * signs


def print_table(model: str, rows: list[Row]) -> None:
    categories = list(dict.fromkeys(row["category"] for row in rows))
    print(f"\n{model}: outward %, % after the better flip, oriented RMSE, seconds\n")
    print("| method | " + " | ".join(categories) + " |\n|---|" + "---|" * len(categories))
    for method in dict.fromkeys(row["method"] for row in rows):
        cells = []
        for category in categories:
            results = [row["result"] for row in rows if row["method"] == method and row["category"] == category]
            done = [result for result in results if result is not None]
            if len(done) < len(results):
                cells.append(f"{len(done)} of {len(results)} finished")
                continue
            mean = {key: np.mean([result[key] for result in done]) for key in done[0]}
            cells.append(
                f"{100 * mean['outward']:.2f}, {100 * mean['better']:.2f}, {mean['rmse']:.1f}°, {mean['seconds']:.2f} s"
            )
        print(f"| {method} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--list", help="file in the folder that names clouds; without it, all")
    parser.add_argument("--model", action="append", help="repeatable; default: the default model")
    parser.add_argument("--method", action="append", choices=METHODS, help="repeatable; default: all")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds per cloud and method")
    parser.add_argument("--results", type=Path, help="JSON lines, one per model, cloud and method; existing ones count")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # what the child processes are asked for
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.folder)))
        return
    from jetnormal.estimators.factory import make_estimator
    from jetnormal.jobs.options import DEFAULT_MODEL

    clouds = categorize(arguments.folder, cloud_names(arguments.folder, arguments.list))
    methods = arguments.method or METHODS
    known: list[Row] = []
    if arguments.results and arguments.results.is_file():
        known = [json.loads(line) for line in arguments.results.read_text().splitlines()]
    for model in arguments.model or [DEFAULT_MODEL]:
        estimator = None if model == "true" else make_estimator(model)
        rows = []
        for cloud, category in clouds.items():
            mine = [row for row in known if (row["model"], row["cloud"]) == (model, cloud) and row["method"] in methods]
            rows += mine
            missing = [method for method in methods if method not in [row["method"] for row in mine]]
            if not missing:
                continue
            points, true, _ = read_cloud(arguments.folder, cloud)
            normals = scrambled(true if estimator is None else estimator(points).normals)
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / f"{cloud}.npz"
                np.savez(file, points=points, normals=normals, true=true)
                for method in missing:
                    result = attempt(method, file, arguments.limit)
                    row = {"model": model, "cloud": cloud, "category": category, "method": method, "result": result}
                    rows.append(row)
                    if arguments.results:
                        with arguments.results.open("a") as stream:
                            stream.write(json.dumps(row) + "\n")
        print_table(model, rows)


if __name__ == "__main__":
    main()
