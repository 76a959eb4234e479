"""Signs once for all tiles: a thinned cloud that fits into memory gets them as any cloud does."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Source
from jetnormal.geometry.neighbors import distinct
from jetnormal.geometry.thinning import least
from jetnormal.jobs.options import EstimateOptions
from jetnormal.jobs.tiled.plan import Plan
from jetnormal.jobs.tiled.store import Store
from jetnormal.jobs.tiled.work import FIND, THINNED
from jetnormal.orientation.auto import ENOUGH
from jetnormal.orientation.decision import Decision
from jetnormal.orientation.policy import settle

DECISION = "decision"


def settle_signs(store: Store, plan: Plan, options: EstimateOptions, source: Source, most: int) -> Decision:
    """Choose the signs of a thinned cloud and leave it in the folder, unless it is there.

    Args:
        store, plan: of a cloud whose tiles have their directions.
        options: how.
        source: what the file says of itself.
        most: points of the thinned cloud, about.
    """
    known = store.read_json(DECISION)
    if known is not None:
        return Decision(**known)
    points, normals = [], []
    if options.orient == "auto":
        most = min(most, ENOUGH)
    for tile, rows in enumerate(_chosen(store, len(plan.counts), most)):
        points.append(store.raw("points", tile)[rows])
        normals.append(store.load(FIND, tile)["normal"][rows])
    together, directions = np.concatenate(points), np.concatenate(normals).astype(np.float64)
    first, _ = distinct(together)
    first = first[np.isfinite(directions[first]).all(axis=1)]
    orientation, decision = settle(together[first], directions[first], options.orient, None, source)
    sure = orientation.confidence.astype(np.float64)
    store.write_arrays(THINNED, {"points": together[first], "normals": orientation.normals, "sure": sure})
    store.write_json(DECISION, json.loads(json.dumps(asdict(decision), default=_plain)))
    return decision


def _chosen(store: Store, tiles: int, most: int) -> Iterator[NDArray[np.int64]]:
    """The rows of each tile that go into the thinned cloud: those with the least ranks of all."""
    samples = [store.load("sample", tile) for tile in range(tiles)]
    lowest: NDArray[np.float64] = np.empty(0)
    for sample in samples:
        lowest = np.concatenate([lowest, sample["rank"]])
        lowest = lowest[least(lowest, most)]
    for sample in samples:
        yield np.sort(sample["row"][sample["rank"] <= lowest.max()])


def _plain(value: Any) -> Any:
    """NumPy's numbers as Python's."""
    return value.item()
