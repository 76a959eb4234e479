"""The results of the tiles, back in the order of the input."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.formats import CloudStream
from jetnormal.formats.streams import ROWS
from jetnormal.jobs.estimate import Result, with_normals
from jetnormal.jobs.options import EstimateOptions, FileOptions
from jetnormal.jobs.prediction import turned_curvatures
from jetnormal.jobs.tiled.plan import Plan
from jetnormal.jobs.tiled.store import FOUND, SIGNED, Store
from jetnormal.jobs.tiled.work import FIND, SIGN
from jetnormal.orientation.decision import Decision
from jetnormal.support.report import progress


class Merge:
    """Write the output; then hold what the summary says of it.

    Attributes:
        valid: points that have a normal.
        warnings: of the attributes and the format.
    """

    def __init__(
        self, store: Store, plan: Plan, options: EstimateOptions, decision: Decision, has_curvature: bool
    ) -> None:
        self._store, self._plan, self._options, self._decision = store, plan, options, decision
        self._has_curvature = has_curvature
        rows = [store.raw("rows", tile) for tile in range(len(plan.counts))]
        self._spans = np.array([(held[0], held[-1]) for held in rows])
        self._points = sum(plan.counts)
        self.valid = 0
        self._sure = 0.0
        self.warnings: list[str] = []

    def write(self, stream: CloudStream, target: Path, files: FileOptions, *, overwrite: bool) -> None:
        """Read the input once more and write it with the results."""
        losses = formats.write_pieces(
            self._pieces(stream),
            self._plan.points,
            self._plan.box,
            target,
            format=formats.format_for(target, files.format),
            encoding=files.encoding,
            overwrite=overwrite,
        )
        self.warnings += losses

    @property
    def confidence(self) -> float:
        """Mean of the signs' confidence."""
        return round(self._sure / max(1, self._points), 4)

    def _pieces(self, stream: CloudStream) -> Iterator[Cloud]:
        start = 0
        with progress("writing points", stream.points) as advance:
            for cloud in stream.pieces(ROWS):
                result = self._result(*self._gather(start, len(cloud)))
                finished, replaced = with_normals(cloud, result, self._options)
                self.warnings = replaced
                self.valid += int(result.valid.sum())
                self._sure += float(np.nansum(result.sign_confidence))
                yield finished
                start += len(cloud)
                advance(len(cloud))

    def _gather(self, start: int, count: int) -> tuple[NDArray[np.void], NDArray[np.void]]:
        """The results for the rows from `start` on; NaN for rows that are in no tile."""
        found, signed = np.zeros(count, FOUND), np.zeros(count, SIGNED)
        for name in FOUND.names or ():
            found[name] = np.nan
        signed["sure"] = np.nan
        first, last = self._spans.T
        for tile in np.flatnonzero((first < start + count) & (last >= start)).tolist():
            rows = self._store.raw("rows", tile)
            held = slice(*np.searchsorted(rows, (start, start + count)))
            places = rows[held] - start
            found[places], signed[places] = self._store.load(FIND, tile)[held], self._store.load(SIGN, tile)[held]
        return found, signed

    def _result(self, found: NDArray[np.void], signed: NDArray[np.void]) -> Result:
        flip = signed["flip"]
        normals = np.where(flip[:, None], -found["normal"], found["normal"]).astype(np.float64)
        curvatures = turned_curvatures(found["curvatures"], flip) if self._has_curvature else None
        model = ""  # is told of the whole cloud
        return Result(normals, found["confidence"], curvatures, signed["sure"], model, self._decision, (), {})
