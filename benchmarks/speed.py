"""Points per second and peak memory of every estimator, beside Open3D's, on one cloud in one run.

    python benchmarks/speed.py [--points 100000] [--repeats 3] [--model deepfit-small --model pca:k=30 ...]
    python benchmarks/speed.py --stages cloudfit
    python benchmarks/speed.py --command [--sizes 10000 100000 1000000] [--repeats 5]
    python benchmarks/speed.py --memory [--sizes 1000000 2000000] [--model pca:k=16 ...]

The cloud is a procedural solid with a little noise (0.25 % of its diagonal), from seed 1; nothing is downloaded.
Each model runs in a process of its own, so that its peak memory is its own; the time is the median over the repeats,
from an array of points to unoriented normals, imports apart. The ratio is to Open3D's estimate_normals with k = 30.
With --command the whole command is timed instead, from the start of the process to its end, beside a script that does
the same with Open3D: import, read, estimate_normals(k=30), perhaps orient_normals_consistent_tangent_plane(12), write.
With --memory, the peak memory of the whole command is measured instead, signs included, and how it grows.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

OPEN3D = "open3d:k=30"
LARGEST_TANGENT_PLANES = 200_000  # points: with more, orient_normals_consistent_tangent_plane takes minutes
DEFAULT_MODELS = ["pca:k=30", "jet:k=30,order=2", "jet:k=60,order=2", "cloudfit", "deepfit-small"]


def cloud(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) points and their true normals."""
    from jetnormal.data.corruption import add_noise
    from jetnormal.data.solids.draw import random_solid

    rng = np.random.default_rng(1)
    points, normals = random_solid(rng).sample(count, rng)
    return add_noise(points, 2.5e-3, rng), normals


def open3d_normals(points: np.ndarray, k: int) -> np.ndarray:
    from jetnormal.support.open3d_loader import import_open3d

    open3d = import_open3d()
    if open3d is None:
        raise SystemExit("Open3D cannot be imported here")
    legacy = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    legacy.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(k))
    return np.asarray(legacy.normals)


def measure(model: str, count: int, repeats: int) -> dict[str, float]:
    """Run one model in this process; return its median seconds, RMSE in degrees, peak memory in MB."""
    from jetnormal.estimators.factory import make_estimator
    from jetnormal.geometry.metrics import angles, rmse
    from jetnormal.support.report import peak_memory_mb

    points, true = cloud(count)
    if model.startswith("open3d"):
        k = int(model.partition("=")[2])

        def run(points: np.ndarray) -> np.ndarray:
            return open3d_normals(points, k)
    else:
        estimator = make_estimator(model)

        def run(points: np.ndarray) -> np.ndarray:
            return estimator(points).normals

    run(points[:10_000])  # imports, compilation and warm-up
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        normals = run(points)
        seconds.append(time.perf_counter() - start)
    memory = peak_memory_mb() or float("nan")
    return {"seconds": float(np.median(seconds)), "rmse": rmse(angles(normals, true)), "memory": memory}


def print_stages(model: str, count: int, repeats: int) -> None:
    """Where a whole-cloud model spends its time, as a table."""
    from jetnormal.estimators.factory import make_estimator
    from jetnormal.estimators.whole_cloud import CloudEstimator
    from jetnormal.geometry.neighbors import NeighborIndex, spatial_order
    from jetnormal.geometry.pyramid import NEIGHBORS, build_pyramid

    estimator = make_estimator(model)
    if not isinstance(estimator, CloudEstimator):
        raise SystemExit(f"{model} looks at patches: it has no stages")
    points, _ = cloud(count)
    ordered = points[spatial_order(points)]
    levels = len(estimator.config.channels)
    pyramid = build_pyramid(ordered, levels)
    stages: dict[str, Callable[[], object]] = {
        "spatial order": lambda: spatial_order(points),
        "neighbors of the cloud": lambda: NeighborIndex(ordered).query(ordered, NEIGHBORS + 1),
        "pyramid, with these neighbors": lambda: build_pyramid(ordered, levels),
        "network": lambda: estimator.find(pyramid, 1, None),
        "all, with curvatures": lambda: estimator(points),
    }
    print("| stage | seconds |\n|---|---|")
    for name, stage in stages.items():
        print(f"| {name} | {median_seconds(stage, repeats):.2f} |", flush=True)


OPEN3D_SCRIPT = """
import sys
from jetnormal.support.open3d_loader import import_open3d
o3d = import_open3d()
cloud = o3d.io.read_point_cloud(sys.argv[1])
cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
if len(sys.argv) > 3:
    cloud.orient_normals_consistent_tangent_plane(12)
o3d.io.write_point_cloud(sys.argv[2], cloud)
"""


def print_command(sizes: list[int], repeats: int) -> None:
    """The wall clock of the whole command in fresh processes, by stage, as a table."""
    import jetnormal

    stages = ("model", "read", "clean", "estimate", "orient", "write")
    columns = ["points", "command", "s", "over Open3D", *stages, "peak memory"]
    print(f"median of {repeats}; seconds\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
    for count in sizes:
        with tempfile.TemporaryDirectory() as folder:
            source, target = str(Path(folder) / "in.ply"), str(Path(folder) / "out.ply")
            jetnormal.write(jetnormal.Cloud(cloud(count)[0]), source)
            script = [sys.executable, "-c", OPEN3D_SCRIPT, source, target]
            command = [sys.executable, "-m", "jetnormal", "estimate", source, "-o", target, "--force", "--json"]
            plain = timed(script, repeats)
            print_row(count, "Open3D, k=30", plain, plain, None)
            if count <= LARGEST_TANGENT_PLANES:
                print_row(count, "Open3D, k=30, oriented", timed([*script, "oriented"], repeats), plain, None)
            empty = dict(os.environ, NUMBA_CACHE_DIR=str(Path(folder) / "cache"))
            first = timed(command, 1, empty)
            print_row(count, "jetnormal, nothing compiled", first, plain, stages)
            print_row(count, "jetnormal", timed(command, repeats), plain, stages)


def print_memory(models: list[str], sizes: list[int]) -> None:
    """The peak memory of the whole command, and between the two largest sizes the growth by a million points."""
    import jetnormal

    *_, less, most = sorted(sizes)
    print(f"| model | {' | '.join(f'{count:,} points' for count in sizes)} | each further million |")
    print("|---|" + "---|" * (len(sizes) + 1))
    with tempfile.TemporaryDirectory() as folder:
        for count in sizes:
            jetnormal.write(jetnormal.Cloud(cloud(count)[0]), Path(folder) / f"{count}.ply")
        for model in models:
            peaks = {}
            for count in sizes:
                source, target = str(Path(folder) / f"{count}.ply"), str(Path(folder) / "out.ply")
                command = [sys.executable, "-m", "jetnormal", "estimate", source, "-o", target, "--force", "--json"]
                peaks[count] = timed([*command, "--model", model], 1)[0]["peak_memory_mb"] / 1000
            further = (peaks[most] - peaks[less]) / (most - less) * 1e6
            cells = [model, *(f"{peaks[count]:.2f} GB" for count in sizes), f"{further:.2f} GB"]
            print(f"| {' | '.join(cells)} |", flush=True)


def timed(command: list[str], repeats: int, environment: dict[str, str] | None = None) -> list[dict[str, Any]]:
    """What fresh processes print as JSON, with their wall clock under "wall", the quickest first."""
    runs = []
    for _ in range(repeats):
        start = time.perf_counter()
        output = subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout
        wall = time.perf_counter() - start
        runs.append((json.loads(output) if output.startswith("{") else {}) | {"wall": wall})
    return sorted(runs, key=lambda run: run["wall"])


def print_row(
    count: int, name: str, runs: list[dict[str, Any]], plain: list[dict[str, Any]], stages: tuple[str, ...] | None
) -> None:
    """A row of the table of commands, of the run with the median wall clock."""
    run, reference = runs[len(runs) // 2], plain[len(plain) // 2]
    cells = [f"{count:,}", name, f"{run['wall']:.2f}", f"{run['wall'] / reference['wall']:.1f}x"]
    cells += [f"{run['seconds'][stage]:.2f}" for stage in stages] if stages else [""] * 6
    cells.append(f"{run['peak_memory_mb']:,.0f} MB" if stages else "")
    print(f"| {' | '.join(cells)} |", flush=True)


def median_seconds(run: Callable[[], object], repeats: int) -> float:
    """The median time of a call, after one that is not counted."""
    run()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--model", action="append", help="repeatable; the default is a choice of all kinds")
    parser.add_argument("--stages", metavar="MODEL", help="print where a whole-cloud model spends its time")
    parser.add_argument("--command", action="store_true", help="time the whole command beside a script with Open3D")
    parser.add_argument("--memory", action="store_true", help="peak memory of the whole command")
    parser.add_argument("--sizes", type=int, nargs="+", help="for --command and --memory")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # what the child processes are asked for
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.points, arguments.repeats)))
        return
    if arguments.command:
        print_command(arguments.sizes or [10_000, 100_000, 1_000_000], arguments.repeats)
        return
    if arguments.memory:
        print_memory(arguments.model or ["cloudfit", "pca:k=16", "jet"], arguments.sizes or [1_000_000, 2_000_000])
        return
    if arguments.stages:
        print_stages(arguments.stages, arguments.points, arguments.repeats)
        return
    rows = {}
    print(f"{arguments.points:,} points, median of {arguments.repeats}\n")
    print("| model | seconds | points/s | over Open3D | RMSE | peak memory |\n|---|---|---|---|---|---|")
    for model in [OPEN3D, *(arguments.model or DEFAULT_MODELS)]:
        command = [sys.executable, __file__, "--one", model, "--points", str(arguments.points)]
        command += ["--repeats", str(arguments.repeats)]
        output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        row = rows[model] = json.loads(output.splitlines()[-1])
        print(
            f"| {model} | {row['seconds']:.2f} | {arguments.points / row['seconds']:,.0f} "
            f"| {row['seconds'] / rows[OPEN3D]['seconds']:.1f}x | {row['rmse']:.2f}° | {row['memory']:,.0f} MB |",
            flush=True,
        )


if __name__ == "__main__":
    main()
