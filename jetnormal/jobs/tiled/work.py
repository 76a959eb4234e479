"""The tasks of a tile: find the directions of its points, and later their signs. They need the folder alone."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Source
from jetnormal.estimators.base import Estimator
from jetnormal.geometry.blocks import Spacing, nearest, seen_from, widest
from jetnormal.geometry.cells import near_boxes
from jetnormal.geometry.neighbors import distinct
from jetnormal.geometry.thinning import least, ranks
from jetnormal.jobs import memory
from jetnormal.jobs.options import EstimateOptions
from jetnormal.jobs.prediction import kept_estimator, predict
from jetnormal.jobs.tiled.plan import Plan
from jetnormal.jobs.tiled.store import FOUND, SAMPLE, SIGNED, Store
from jetnormal.orientation.carrying import SIGN_REACH, Thinned, carry_signs
from jetnormal.orientation.policy import settle
from jetnormal.orientation.sensors import Sensors

Floats = NDArray[np.float64]

CANDIDATES = 50_000  # points of a tile, at least, that may go into the thinned cloud

SPACING = "spacing"
THINNED = "thinned"
FIND, SIGN = "found", "signed"
"""The two tasks of a tile, by the name of what they leave behind."""


def run_task(folder: Path, kind: str, tile: int, options: EstimateOptions) -> int:
    """Do a task of a tile, unless it is done already; return the number of points."""
    store = Store(folder)
    plan = Plan.of(store)
    assert plan is not None
    if not store.has(kind, tile):
        if kind == FIND:
            find_directions(store, plan, tile, options, kept_estimator(options))
        else:
            find_signs(store, plan, tile, options)
    return plan.counts[tile]


def _thinned(folder: Path) -> Thinned:
    """The thinned cloud, read once for all tiles of a process."""
    return _read_thinned(folder, Store(folder).stamp(THINNED))


@lru_cache(maxsize=1)
def _read_thinned(folder: Path, stamp: tuple[int, int]) -> Thinned:
    return Thinned(**Store(folder).read_arrays(THINNED))


def find_directions(store: Store, plan: Plan, tile: int, options: EstimateOptions, estimator: Estimator) -> None:
    """Estimate the directions of a tile, with its halo as further neighbors."""
    points = np.array(store.raw("points", tile))
    first, copies = distinct(points)
    core = points[first]
    halo = _halo(store, plan, tile, len(core), estimator.reach, options.threads)
    seen = np.concatenate([core, *(store.raw("points", other)[rows] for other, rows in halo)])
    prediction, name, warnings = predict(seen, estimator, options, _silent, np.arange(len(core)))
    found = np.empty(len(core), FOUND)
    found["normal"], found["confidence"] = prediction.normals, prediction.confidence
    found["curvatures"] = np.nan if prediction.curvatures is None else prediction.curvatures
    candidates = _candidates(core, seen[len(core) :], len(plan.counts), options.threads)
    candidates["row"] = first[candidates["row"]]
    store.save("sample", tile, candidates)
    has_curvature = prediction.curvatures is not None
    said = {"model": name, "warnings": warnings, "has_curvature": has_curvature}
    degenerate = ~np.isfinite(found["normal"]).all(axis=1)
    store.write_json(f"{tile:05}", said | {"degenerate": int(degenerate[copies].sum())})
    store.save(FIND, tile, found[copies])


def _halo(
    store: Store, plan: Plan, tile: int, core: int, reach: float, threads: int | None
) -> list[tuple[int, NDArray[np.int64]]]:
    """What a tile of so many different points sees of others: their numbers, and rows (n,) of different points."""
    widths = [widest(high - low, count) for (low, high), count in zip(plan.boxes, plan.counts, strict=True)]
    others = near_boxes(plan.boxes, tile, reach * np.array(widths))
    seen = []
    for other in others:
        points = np.array(store.raw("points", other))
        rows, apart = seen_from(plan.boxes[tile], points, _spacing(store, other, points, threads), reach)
        first = np.sort(distinct(points[rows])[0])  # copies of a point are in one tile
        seen.append((rows[first], apart[first]))
    return list(zip(others, nearest(seen, core), strict=True))


def _spacing(store: Store, tile: int, points: Floats, threads: int | None) -> Spacing:
    """How far apart the points of a tile are; the first who asks finds it for all."""
    if not store.has(SPACING, tile):
        found = Spacing.of(points[distinct(points)[0]], threads)
        store.save(SPACING, tile, np.column_stack([found.sample, found.values]))
    held = np.array(store.load(SPACING, tile))
    return Spacing(held[:, :3], held[:, 3], threads)


def find_signs(store: Store, plan: Plan, tile: int, options: EstimateOptions) -> None:
    """Choose the signs of a tile: by its sensors or the option, or those of the thinned cloud."""
    points, normals, sensors, owner = _with_neighbors(store, plan, tile, options)
    if signs_are_local(plan, options):
        orientation, _ = settle(points, normals, options.orient, sensors, Source())
        flips = np.einsum("nd,nd->n", orientation.normals, normals) < 0
        sure = orientation.confidence.astype(np.float64)
    else:
        flips, sure = carry_signs(points, normals, _thinned(store.folder))
    count = plan.counts[tile]
    signed = np.zeros(count, SIGNED)
    signed["flip"], signed["sure"] = flips[owner], sure[owner]
    store.save(SIGN, tile, signed)


def signs_are_local(plan: Plan, options: EstimateOptions) -> bool:
    """Tell whether the sign of a point follows from its surroundings alone."""
    return plan.sensors is not None or options.orient in ("up", "none")


def _with_neighbors(
    store: Store, plan: Plan, tile: int, options: EstimateOptions
) -> tuple[Floats, Floats, Sensors | None, NDArray[np.int64]]:
    """Distinct points of a tile and of what is near, directions, sensors, and the rows (n,) of the tile's points."""
    inside = store.raw("points", tile)
    parts, directions, places = [np.array(inside)], [store.load(FIND, tile)["normal"]], []
    has_places = plan.sensors is not None and plan.place is None
    if has_places:
        places.append(np.array(store.raw("sensors", tile)))
    for other, rows in _halo(store, plan, tile, len(inside), SIGN_REACH, options.threads):
        parts.append(store.raw("points", other)[rows])
        directions.append(store.load(FIND, other)["normal"][rows])
        if has_places:
            places.append(np.array(store.raw("sensors", other)[rows]))
    points = np.concatenate(parts)
    first, copies = distinct(points)
    normals = np.concatenate(directions)[first].astype(np.float64)
    sensors = None
    if plan.place is not None:
        sensors = Sensors(plan.place, str(plan.sensors))
    elif has_places:
        sensors = Sensors(np.concatenate(places)[first], str(plan.sensors))
    return points[first], normals, sensors, copies[: len(inside)]


def _candidates(core: Floats, halo: Floats, tiles: int, threads: int | None) -> NDArray[np.void]:
    """Points of one of many tiles that may go into the thinned cloud, by their numbers in the core."""
    ranked = ranks(core, halo, threads=threads)
    rows = least(ranked, max(CANDIDATES, 2 * memory.THINNED // tiles))
    found = np.empty(len(rows), SAMPLE)
    found["row"], found["rank"] = rows, ranked[rows]
    return found


def _silent(count: int, note: str = "") -> None:
    """Show no progress within a tile."""
