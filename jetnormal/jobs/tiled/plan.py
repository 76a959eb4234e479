"""The first two passes over a large cloud: choose the cuts, then write each point into its tile."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, check_coordinates
from jetnormal.errors import InputError
from jetnormal.formats import CloudStream
from jetnormal.formats.streams import ROWS
from jetnormal.geometry.cells import Cells, cut_into_cells, halvings, in_sample
from jetnormal.geometry.neighbors import distinct
from jetnormal.jobs.options import EstimateOptions
from jetnormal.jobs.tiled.store import Store
from jetnormal.support.report import progress

Floats = NDArray[np.float64]

PLAN = "plan"


@dataclass(frozen=True)
class Plan:
    """The tiles of a cloud.

    Attributes:
        points: rows of the file.
        counts: finite points of each tile.
        boxes: (T, 2, 3) least and largest coordinates of each tile.
        sensors: where the positions of the sensor are known from; None if they are not known.
        place: (3,) position from which all points were seen; None if each has its own, or none.
        unseen: number of points whose sensor position is not known.
    """

    points: int
    counts: list[int]
    boxes: Floats
    sensors: str | None
    place: Floats | None
    unseen: int

    @classmethod
    def of(cls, store: Store) -> Plan | None:
        """Read the plan of a folder; None if its points are not in their tiles yet."""
        content = store.read_json(PLAN)
        if content is None:
            return None
        place = None if content["place"] is None else np.asarray(content["place"])
        return cls(
            content["points"],
            content["counts"],
            np.asarray(content["boxes"]),
            content["sensors"],
            place,
            content["unseen"],
        )

    @property
    def box(self) -> Floats:
        """(2, 3) of all finite points."""
        return np.stack([self.boxes[:, 0].min(axis=0), self.boxes[:, 1].max(axis=0)])


def distribute(stream: CloudStream, store: Store, options: EstimateOptions, largest: int) -> Plan:
    """Write the finite points of a file into tiles.

    Args:
        stream: the file.
        store: an empty folder.
        options: the options of the user, which may tell the sensor.
        largest: points of a tile, about.

    Raises:
        InputError: the file holds no surface, or coordinates that cannot be computed with.
    """
    with progress("reading points", 2 * stream.points) as advance:
        times = halvings(stream.points)
        sample = _sample(stream, times, advance)
        if len(sample) < 3:
            raise InputError(f"{len(sample)} different finite points of {stream.points}: a normal needs at least 3")
        plan = _write_tiles(stream, store, options, cut_into_cells(sample, times, largest), advance)
    content = asdict(plan) | {
        "boxes": plan.boxes.tolist(),
        "place": None if plan.place is None else plan.place.tolist(),
    }
    store.write_json(PLAN, content)
    return plan


def _sample(stream: CloudStream, times: int, advance: Any) -> Floats:
    """The distinct points of the sample from which the cuts are chosen."""
    parts = []
    for cloud in stream.pieces(ROWS):
        points = cloud.points[cloud.valid]
        check_coordinates(points)
        parts.append(points[in_sample(points, times)])
        advance(len(cloud))
    sample = np.concatenate(parts)
    return sample[distinct(sample)[0]]


def _write_tiles(stream: CloudStream, store: Store, options: EstimateOptions, cells: Cells, advance: Any) -> Plan:
    from jetnormal.orientation.policy import find_sensors

    count = len(cells)
    counts = np.zeros(count, dtype=np.int64)
    boxes = np.tile(np.array([[np.inf], [-np.inf]]), (count, 1, 3))
    reason, place, start, unseen = None, None, 0, 0
    for cloud in stream.pieces(ROWS):
        sensors = find_sensors(options, cloud)
        if sensors is not None:
            reason, place = sensors.reason, sensors.places if sensors.places.ndim == 1 else None
        places = sensors.places if sensors is not None and sensors.places.ndim == 2 else None
        if places is not None:
            unseen += int((~np.isfinite(places).all(axis=1)).sum())
        _append(store, cells, cloud, start, places, counts, boxes)
        start += len(cloud)
        advance(len(cloud))
    return Plan(start, counts.tolist(), boxes, reason, place, unseen)


def _append(
    store: Store,
    cells: Cells,
    cloud: Cloud,
    start: int,
    places: Floats | None,
    counts: NDArray[np.int64],
    boxes: Floats,
) -> None:
    """Append the finite points of a piece, whose first row is `start`, to their tiles."""
    rows = np.flatnonzero(cloud.valid)
    tile = cells.of(cloud.points[rows])
    order = np.argsort(tile, kind="stable")
    numbers, begins = np.unique(tile[order], return_index=True)
    for number, part in zip(numbers, np.split(rows[order], begins[1:]), strict=True):
        points = cloud.points[part]
        store.append("points", number, points)
        store.append("rows", number, part + start)
        if places is not None:
            store.append("sensors", number, places[part])
        counts[number] += len(part)
        low, high = boxes[number]
        boxes[number] = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
