"""Estimated normals kept on disk, so that an interrupted evaluation goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal._version import __version__
from jetnormal.errors import InputError, ResourceError, unreadable
from jetnormal.formats.atomic import atomic_write, make_folder
from jetnormal.formats.npz import load_arrays
from jetnormal.support.report import logger


@dataclass(frozen=True)
class Estimate:
    """The estimate of a model for a cloud.

    Attributes:
        normals: (Q, 3) of the points evaluated.
        points: number of points whose normals were estimated, at least Q.
        seconds: of the estimation with its neighbor search, without reading files and choosing signs; None if unknown.
    """

    normals: NDArray[np.floating[Any]]
    points: int
    seconds: float | None


class ResultStore:
    """A folder with one file per model, settings and cloud.

    An estimate is found again only if the model file, the cloud's files, the settings and the version of the program
    are the same. Outdated estimates stay in the folder, unread.
    """

    def __init__(self, folder: Path) -> None:
        """Create the folder if need be.

        Raises:
            InputError: it cannot be created.
        """
        make_folder(folder)
        self._folder = folder

    def path(self, cloud: str, facts: dict[str, Any]) -> Path:
        """Return the path of an estimate. `facts` are plain values on which it depends, "model" among them."""
        text = json.dumps(facts | {"version": __version__}, sort_keys=True)
        model = re.sub(r"[^\w.,=-]+", "_", facts["model"])[-60:]
        return self._folder / f"{cloud}.{model}.{hashlib.sha256(text.encode()).hexdigest()[:16]}.npz"

    def load(self, path: Path, count: int) -> Estimate | None:
        """Read what `save` wrote there, of `count` points; None if there is nothing, or if it is damaged."""
        if not path.is_file():
            return None
        try:
            normals, points, seconds = load_arrays(path, "normals", "points", "seconds")
            if normals.shape != (count, 3) or normals.dtype != np.float32 or points.shape or seconds.shape:
                raise InputError(f"{path}: holds no estimate of {count} points")
            return Estimate(normals, int(points), float(seconds))
        except (InputError, ResourceError, TypeError, ValueError, OverflowError) as error:
            logger.warning("damaged: %s; estimating anew", error)
            return None

    def save(self, path: Path, estimate: Estimate) -> None:
        """Keep an estimate.

        Raises:
            InputError: the file cannot be written.
        """
        assert estimate.seconds is not None
        with atomic_write(path, overwrite=True) as stream:
            np.savez(stream, normals=estimate.normals, points=estimate.points, seconds=estimate.seconds)


def digest(*paths: Path) -> str:
    """Return a fingerprint of what is in the files, in their order.

    Raises:
        InputError: one cannot be read.
    """
    found = hashlib.sha256()
    for path in paths:
        try:
            found.update(hashlib.sha256(path.read_bytes()).digest())
        except OSError as error:
            raise unreadable(path, error) from error
    return found.hexdigest()
