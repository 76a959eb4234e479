"""What is compared in an evaluation: a model, or the normals of another program."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError
from jetnormal.estimators.base import Estimator
from jetnormal.evaluation.clouds import BenchmarkCloud
from jetnormal.evaluation.options import EvaluateOptions
from jetnormal.evaluation.results import CloudResult
from jetnormal.evaluation.scores import score
from jetnormal.evaluation.store import Estimate, ResultStore, digest
from jetnormal.evaluation.zangles import ZAngles, measure_z_angles
from jetnormal.formats.pcpnet import read_normals, write_normals
from jetnormal.support.report import Advance, logger


@dataclass(frozen=True)
class Trial:
    """Something that has normals for the clouds of a benchmark, and the name it has in tables."""

    name: str

    def run(
        self, cloud: BenchmarkCloud, clean: NDArray[np.float64] | None, options: EvaluateOptions, advance: Advance
    ) -> CloudResult:
        """Score a cloud; `clean` are the normals (Q, 3) of its clean version."""
        estimate = self.estimate(cloud, options, advance)
        if options.export_normals is not None:
            path = exported_to(options.export_normals, self.name, cloud.name)
            write_normals(path, estimate.normals, overwrite=options.overwrite)
        scores, errors = score(estimate.normals, cloud.true_normals, clean, signs=options.orient != "none")
        logger.debug("%s, %s: RMSE %.2f degrees", cloud.name, self.name, scores.rmse)
        angles = self.z_angles(cloud) if options.z_angles else None
        return CloudResult(scores, errors, estimate.points, estimate.seconds, angles)

    def estimate(self, cloud: BenchmarkCloud, options: EvaluateOptions, advance: Advance) -> Estimate:
        """Return the normals at the points evaluated."""
        raise NotImplementedError

    def z_angles(self, cloud: BenchmarkCloud) -> ZAngles | None:
        """Measure what the learned transform of a patch network does; None without one."""
        return None


@dataclass(frozen=True)
class Given(Trial):
    """The normals of another program, in a folder."""

    folder: Path

    def estimate(self, cloud: BenchmarkCloud, options: EvaluateOptions, advance: Advance) -> Estimate:
        """See `Trial`."""
        normals = read_normals(self.folder / f"{cloud.name}.normals")
        if len(normals) == len(cloud.points):
            normals = normals[cloud.queries]
        elif len(normals) != len(cloud.queries):
            raise InputError(
                f"{self.folder / cloud.name}.normals: {len(normals)} rows for {len(cloud.points)} points, "
                f"{len(cloud.queries)} of them evaluated"
            )
        advance(len(cloud.points) if options.orient != "none" else len(cloud.queries))
        return Estimate(normals, len(normals), None)


@dataclass(frozen=True)
class Estimated(Trial):
    """A model, and where its estimates are kept: `facts` are what they depend on beside the cloud."""

    estimator: Estimator
    facts: dict[str, Any]
    store: ResultStore | None

    def z_angles(self, cloud: BenchmarkCloud) -> ZAngles | None:
        """See `Trial`."""
        return measure_z_angles(self.estimator, cloud)

    def estimate(self, cloud: BenchmarkCloud, options: EvaluateOptions, advance: Advance) -> Estimate:
        """See `Trial`: the estimate that was kept, or a new one, which is kept."""
        if self.store is None:
            return self._estimate(cloud, options.orient, advance)
        path = self.store.path(cloud.name, self.facts | {"cloud": digest(*cloud.files)})
        estimate = self.store.load(path, len(cloud.queries))
        if estimate:
            advance(estimate.points)
            return estimate
        estimate = self._estimate(cloud, options.orient, advance)
        self.store.save(path, estimate)
        return estimate

    def _estimate(self, cloud: BenchmarkCloud, orient: str, advance: Advance) -> Estimate:
        from jetnormal.orientation.methods import choose_signs

        rows = cloud.queries if orient == "none" else np.arange(len(cloud.points))
        start = time.perf_counter()
        normals = self.estimator(cloud.points, rows, advance).normals
        seconds = time.perf_counter() - start
        if orient != "none":
            signs = choose_signs(cloud.points, normals, orient, viewpoint=cloud.sensors)  # type: ignore[arg-type]
            normals = signs.normals[cloud.queries]
        return Estimate(normals, len(rows), seconds)


def exported_to(folder: Path, model: str, cloud: str) -> Path:
    """Return where the normals of a model, whose name may be a path, for a cloud are written."""
    return folder / re.sub(r"[^\w.,=-]+", "_", model)[-100:] / f"{cloud}.normals"
