"""Signs once for all tiles: a thinned cloud that fits into memory gets them as any cloud does."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from jetnormal.cloud import Source
from jetnormal.geometry.neighbors import distinct
from jetnormal.jobs.options import EstimateOptions
from jetnormal.jobs.tiled.plan import Plan
from jetnormal.jobs.tiled.store import Store
from jetnormal.jobs.tiled.work import FIND, THINNED
from jetnormal.orientation.policy import Decision, settle

MOST = 1_000_000  # points of the thinned cloud
DECISION = "decision"


def settle_signs(store: Store, plan: Plan, options: EstimateOptions, source: Source, most: int = MOST) -> Decision:
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
    samples = [store.load("sample", tile) for tile in range(len(plan.counts))]
    share = min(1.0, most / max(1, sum(map(len, samples))))
    points, normals = [], []
    for tile, sample in enumerate(samples):
        rows = np.sort(sample[np.arange(0, len(sample), 1 / share).astype(np.int64)]) if len(sample) else sample
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


def _plain(value: Any) -> Any:
    """NumPy's numbers as Python's."""
    return value.item()
