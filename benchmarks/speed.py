"""Points per second and peak memory of every estimator, beside Open3D's, on one cloud in one run.

    python benchmarks/speed.py [--points 100000] [--repeats 3] [--model deepfit-small --model pca:k=30 ...]
    python benchmarks/speed.py --stages cloudfit

The cloud is a procedural solid with a little noise (0.25 % of its diagonal), from seed 1; nothing is downloaded.
Each model runs in a process of its own, so that its peak memory is its own; the time is the median over the repeats,
from an array of points to unoriented normals, imports apart. The ratio is to Open3D's estimate_normals with k = 30.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

OPEN3D = "open3d:k=30"
DEFAULT_MODELS = ["pca:k=30", "jet:k=30,order=2", "jet:k=60,order=2", "cloudfit", "deepfit-small"]


def cloud(count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) points and their true normals."""
    from jetnormal.data.corruption import add_noise
    from jetnormal.data.solids.recipes import random_solid

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
    """Runs one model in this process: median seconds, RMSE in degrees, peak memory in MB."""
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
    import torch

    from jetnormal.estimators.blocks import spatial_order
    from jetnormal.estimators.factory import make_estimator
    from jetnormal.estimators.whole_cloud import CloudEstimator
    from jetnormal.geometry.neighbors import NeighborIndex
    from jetnormal.geometry.pyramid import NEIGHBORS, build_pyramid

    estimator = make_estimator(model)
    if not isinstance(estimator, CloudEstimator):
        raise SystemExit(f"{model} looks at patches: it has no stages")
    points, _ = cloud(count)
    ordered = points[spatial_order(points)]
    levels = len(estimator.network.config.channels)
    with torch.inference_mode():
        pyramid = build_pyramid(ordered, levels)
        encoding = estimator.network.encode(pyramid)
        stages = {
            "spatial order": lambda: spatial_order(points),
            "neighbors of the cloud": lambda: NeighborIndex(ordered).query(ordered, NEIGHBORS + 1),
            "pyramid, with these neighbors": lambda: build_pyramid(ordered, levels),
            "trunk": lambda: estimator.network.encode(pyramid),
            "fit": lambda: estimator.fit_all(encoding, pyramid, torch.arange(count)),
            "all": lambda: estimator(points),
        }
        print("| stage | seconds |\n|---|---|")
        for name, stage in stages.items():
            print(f"| {name} | {median_seconds(stage, repeats):.2f} |", flush=True)


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
    parser.add_argument("--one", help=argparse.SUPPRESS)  # what the child processes are asked for
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one, arguments.points, arguments.repeats)))
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
