"""Clouds that are hard on an estimator, and how far off each model may be on them: `make hostile`, or

    PYTHONPATH=tests python -m robustness.hostile [--points 3000] [--model cloudfit ...]

prints a table of RMSE and of the share of outward normals, with the bounds that tests/robustness/test_hostile.py holds
the models to.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jetnormal
from jetnormal.geometry.metrics import angles

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A cloud with what is known of it.

    Attributes:
        name: of the case.
        points: (N, 3).
        normals: (N, 3) outward; NaN where there is no right answer.
        rmse: degrees that no model may exceed on the points that have a right answer; None if there is none.
        outward: least share of right signs of those points; None where the surface has no outside.
        nothing: whether every normal must be NaN.
    """

    name: str
    points: Points
    normals: Points
    rmse: float | None = None
    outward: float | None = None
    nothing: bool = False


def ball(count: int, seed: int = 0) -> Points:
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def cases(count: int) -> Iterator[Case]:
    unit = ball(count)
    unknown = np.full((1, 3), np.nan)
    rng = np.random.default_rng(1)
    yield Case("sphere", unit, unit, 4, 1.0)
    utm = np.array([456_789.0, 5_432_109.0, 321.0])
    for radius in (5.0, 100.0):
        points = np.concatenate([unit * radius + utm, np.zeros((1, 3))])
        yield Case(f"sphere of radius {radius:g} at UTM, a row 0 0 0", points, np.concatenate([unit, unknown]), 4, 0.99)
    for distance in (1e2, 1e5, 1e140):
        points = np.concatenate([unit, [[distance, 0, 0]]])
        yield Case(f"sphere, a point at {distance:g}", points, np.concatenate([unit, unknown]), 4, 0.99)
    other = ball(count, 2)
    points = np.concatenate([unit, other + np.array([1e6, 0, 0])])
    yield Case("two spheres, 1e6 apart", points, np.concatenate([unit, other]), 4, 0.99)
    spacing = np.sqrt(4 * np.pi / count)
    for share in (1e-2, 1e-4, 1e-9):
        copies = unit + rng.normal(size=unit.shape) * spacing * share
        points, normals = np.concatenate([unit, copies]), np.concatenate([unit, unit])
        yield Case(f"each point twice, {share:g} spacings apart", points, normals, 8, 0.99)
    yield Case("each point three times", np.tile(unit, (3, 1)), np.tile(unit, (3, 1)), 4, 0.99)
    line = rng.random(count)[:, None] * [0.1, 0.7, 0.3] + [5, 6, 7]
    yield Case("collinear", line, np.full_like(line, np.nan), nothing=True)
    up = np.broadcast_to([0.0, 0.0, 1.0], (count, 3))
    flat = np.concatenate([rng.random((count, 2)), np.zeros((count, 1))], axis=1)
    yield Case("plane", flat, up, 0.1)
    side = int(np.sqrt(count))
    grid = np.stack([*np.meshgrid(np.arange(side), np.arange(side)), np.zeros((side, side))], axis=-1).reshape(-1, 3)
    yield Case("plane, a lattice", grid.astype(float), up[: len(grid)], 0.1)
    side = round(count ** (1 / 3))
    cube = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3).astype(float)
    yield Case("lattice in a cube", cube, np.full_like(cube, np.nan))
    angle = np.linspace(0, 40, count)
    helix = np.stack([np.cos(angle), np.sin(angle), angle / 10], axis=1)
    yield Case("helix", helix, np.full_like(helix, np.nan))
    yield Case("noise in a cube", rng.random((count, 3)), np.full((count, 3), np.nan))
    height = np.concatenate([rng.uniform(-1, 0, count // 40), 1 - rng.random(count) ** 2 * 1e-2])
    around = rng.uniform(0, 2 * np.pi, len(height))
    radius = np.sqrt(1 - height**2)
    uneven = np.stack([radius * np.cos(around), radius * np.sin(around), height], axis=1)
    yield Case("sphere, density 1 : 10^4", uneven, uneven, 15, 0.9)
    for size in (1e-100, 1e-45, 1e39, 1e100):
        yield Case(f"sphere of radius {size:g}", unit * size, unit, 4, 1.0)


@dataclass(frozen=True)
class Score:
    """What a model made of a case: degrees, share of right signs, share of NaN rows, and what breaks the bounds."""

    rmse: float | None
    outward: float | None
    missing: float
    faults: tuple[str, ...]


def score(case: Case, model: str, **options: Any) -> Score:
    normals = jetnormal.estimate(case.points, model=model, **options)
    faults = []
    finite = np.isfinite(normals).all(axis=1)
    if not np.allclose(np.linalg.norm(normals[finite], axis=1), 1, atol=1e-4):
        faults.append("normals that are not unit vectors")
    if case.nothing and finite.any():
        faults.append(f"{finite.sum()} normals where there are none")
    known = np.isfinite(case.normals).all(axis=1)
    rmse = outward = None
    if known.any():
        if not finite[known].all():
            faults.append(f"{(~finite[known]).sum()} normals missing")
        both = known & finite
        rmse = float(np.sqrt(np.mean(np.square(angles(normals[both], case.normals[both])))))
        outward = float(((normals[both] * case.normals[both]).sum(axis=1) > 0).mean())
        if case.rmse is not None and not rmse <= case.rmse:
            faults.append(f"RMSE {rmse:.2f} degrees")
        if case.outward is not None and outward < case.outward:
            faults.append(f"{100 * outward:.1f} % outward")
    return Score(rmse, outward if case.outward is not None else None, float((~finite).mean()), tuple(faults))


def main() -> None:
    import warnings

    warnings.simplefilter("ignore")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=3000)
    parser.add_argument("--model", action="append")
    options = parser.parse_args()
    models = options.model or ["cloudfit", "jet", "pca"]
    print("| cloud | bounds |", " | ".join(models), "|\n|---|---|" + "---|" * len(models))
    faults = []
    for case in cases(options.points):
        cells = []
        for model in models:
            found = score(case, model)
            parts = [] if found.rmse is None else [f"{found.rmse:.2f}°"]
            parts += [] if found.outward is None else [f"{100 * found.outward:.1f} %"]
            parts += [] if not found.missing else [f"NaN {100 * found.missing:.3g} %"]
            cells.append(", ".join(parts or ["finite"]) + (" **!**" if found.faults else ""))
            faults += [f"{case.name}, {model}: {fault}" for fault in found.faults]
        bounds = ["all NaN"] if case.nothing else [] if case.rmse is None else [f"{case.rmse:g}°"]
        bounds += [] if case.outward is None else [f"{100 * case.outward:g} %"]
        print(f"| {case.name} | {', '.join(bounds or ['unit or NaN'])} | {' | '.join(cells)} |", flush=True)
    print("\n".join(faults))
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
