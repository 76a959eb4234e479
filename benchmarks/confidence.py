"""How well a model's confidence tells its errors: a reliability table, rank correlations and a plot.

    python benchmarks/confidence.py --data validation [--model cloudfit] [--plot reliability.png]

The confidence of `cloudfit` is the probability that a normal is off by less than 10 degrees. In a calibrated model the
share of such normals among the points of a bin is the bin's mean confidence; the expected calibration error is the
mean of their difference over all points. DATA is a folder in PCPNet's layout; the points are those of its .pidx files.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from jetnormal.estimators.factory import make_estimator
from jetnormal.formats.pcpnet import cloud_names, read_cloud, split_name
from jetnormal.geometry.metrics import angles

SURE = 10.0  # degrees
BINS = 10


def collect(data: Path, model: str) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """For each category, the confidences and the errors in degrees of its clouds' points."""
    estimator = make_estimator(model)
    found: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for name in cloud_names(data, None):
        points, normals, queries = read_cloud(data, name)
        queries = np.arange(len(points)) if queries is None else queries
        prediction = estimator(points, queries)
        errors = angles(prediction.normals, normals[queries])
        found.setdefault(split_name(name)[1], []).append((prediction.confidence.astype(float), errors))
    return {
        category: tuple(np.concatenate(part) for part in zip(*clouds, strict=True))  # type: ignore[misc]
        for category, clouds in found.items()
    }


def reliability(confidence: NDArray[np.float64], errors: NDArray[np.float64]) -> list[tuple[int, float, float]]:
    """For each bin of confidence: points, mean confidence, share of errors below 10 degrees."""
    number = np.minimum((confidence * BINS).astype(int), BINS - 1)
    inside = [number == index for index in range(BINS)]
    return [
        (int(mask.sum()), float(confidence[mask].mean()), float((errors[mask] < SURE).mean()))
        for mask in inside
        if mask.any()
    ]


def plot(path: Path, rows: list[tuple[int, float, float]], model: str) -> None:
    """The reliability diagram, the size of a dot telling how many points are in its bin."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    counts, mean, share = (np.array(column) for column in zip(*rows, strict=True))
    figure, axes = plt.subplots(figsize=(4.2, 4.2), layout="constrained")
    axes.plot([0, 1], [0, 1], color="0.7", linewidth=1, zorder=0)
    axes.plot(mean, share, color="#2a6fbb", linewidth=1.5)
    axes.scatter(mean, share, s=20 + 300 * counts / counts.max(), color="#2a6fbb", alpha=0.8, linewidth=0)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", title=f"{model}: is the confidence right?")
    axes.set(xlabel="confidence", ylabel="share of normals within 10 degrees")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", default="cloudfit")
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    categories = collect(arguments.data, arguments.model)
    print("| category | within 10 degrees | mean confidence | rank correlation with the error |\n|---|---|---|---|")
    for category, (confidence, errors) in categories.items():
        rank = spearmanr(confidence, errors).statistic
        print(f"| {category} | {(errors < SURE).mean():.3f} | {confidence.mean():.3f} | {rank:.2f} |")
    confidence, errors = (np.concatenate(part) for part in zip(*categories.values(), strict=True))
    rows = reliability(confidence, errors)
    off = sum(count * abs(mean - share) for count, mean, share in rows) / len(errors)
    rank = spearmanr(confidence, errors).statistic
    print(f"| all | {(errors < SURE).mean():.3f} | {confidence.mean():.3f} | {rank:.2f} |")
    print(f"\nexpected calibration error {off:.3f}\n")
    print("| points | confidence | within 10 degrees |\n|---|---|---|")
    for count, mean, share in rows:
        print(f"| {count:,} | {mean:.2f} | {share:.2f} |")
    if arguments.plot:
        plot(arguments.plot, rows, arguments.model)


if __name__ == "__main__":
    main()
