"""The positions from which points were seen, as the user or the file tells them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, unreadable

Floats = NDArray[np.float64]


class SensorOptions(Protocol):
    """The options that tell where the sensor was (`jobs.options.NormalOptions`)."""

    @property
    def viewpoint(self) -> tuple[float, float, float] | None: ...
    @property
    def viewpoint_attribute(self) -> tuple[str, str, str] | None: ...
    @property
    def trajectory(self) -> str | None: ...
    @property
    def time_attribute(self) -> str: ...


@dataclass(frozen=True)
class Sensors:
    """Where points were seen from.

    Attributes:
        places: (3,) for all points, or (N, 3) for each; a row is NaN where it is not known.
        reason: where this is known from.
    """

    places: Floats
    reason: str

    def of(self, rows: NDArray[np.int64]) -> Sensors:
        """The sensors of some of the points (R,)."""
        return self if self.places.ndim == 1 else Sensors(self.places[rows], self.reason)


def told_sensors(options: SensorOptions, cloud: Cloud) -> Sensors | None:
    """Find the sensor by the options of the user; None if they tell none.

    Raises:
        InputError: an attribute or the trajectory is missing or cannot be used.
    """
    if options.viewpoint is not None:
        return Sensors(np.asarray(options.viewpoint, dtype=np.float64), "the viewpoint was given")
    if options.viewpoint_attribute is not None:
        names = options.viewpoint_attribute
        places = np.stack([_numbers(cloud, name, "the viewpoints") for name in names], axis=1)
        return Sensors(places, f"the attributes {', '.join(names)} hold the viewpoints")
    if options.trajectory is not None:
        times = _numbers(cloud, options.time_attribute, "the times")
        return Sensors(interpolated(read_trajectory(Path(options.trajectory)), times), "the trajectory was given")
    return None


def file_sensors(cloud: Cloud) -> Sensors | None:
    """Find the sensor by the cloud's file; None if it tells none.

    Programs write the origin into PCD files if they know no viewpoint. So the origin counts only for an organized
    cloud, whose rows and columns are those of a sensor.
    """
    source = cloud.source
    if source.sensors is not None and np.isfinite(source.sensors).any():
        known = f"{source.format.upper()} file" if source.format else "cloud"
        return Sensors(source.sensors, f"the {known} knows its sensors")
    if source.viewpoint is None or not np.isfinite(source.viewpoint[:3]).all():
        return None
    place = np.asarray(source.viewpoint[:3], dtype=np.float64)
    if place.any():
        return Sensors(place, "the file tells its viewpoint")
    if source.format == "pcd" and (source.height or 1) > 1:
        return Sensors(place, "the file is organized in the rows and columns of a sensor at the origin")
    return None


def read_trajectory(path: Path) -> Floats:
    """Read a trajectory (T, 4), T >= 2: time, x, y and z in rows, parted by blanks, commas or semicolons.

    Raises:
        InputError: the file cannot be read, or holds no trajectory.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise unreadable(path, error) from error
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            rows.append([float(word) for word in words[:4]])
            if len(rows[-1]) < 4 or not np.isfinite(rows[-1]).all():
                raise ValueError
        except ValueError:
            if len(rows) <= 1 and number == 1:  # a line of names
                rows.clear()
                continue
            raise InputError(f"{path}: line {number} is not time, x, y, z") from None
    if len(rows) < 2:
        raise InputError(f"{path}: a trajectory needs at least two rows of time, x, y, z")
    table = np.array(rows)
    return table[np.argsort(table[:, 0], kind="stable")]


def interpolated(trajectory: Floats, times: Floats) -> Floats:
    """Find the places (N, 3) of a trajectory (T, 4) at times (N,); NaN before its start and after its end."""
    known = (times >= trajectory[0, 0]) & (times <= trajectory[-1, 0])
    places = np.stack([np.interp(times, trajectory[:, 0], column) for column in trajectory[:, 1:].T], axis=1)
    places[~known] = np.nan
    return places


def _numbers(cloud: Cloud, name: str, what: str) -> Floats:
    """An attribute as numbers (N,), by its name in any case."""
    if name not in cloud.attributes:
        plain = {known.lower().replace("_", ""): known for known in cloud.attributes}
        known = plain.get(name.lower().replace("_", ""))
        if known is None:
            there = ", ".join(cloud.attributes) or "none"
            raise InputError(f"there is no attribute {name!r} to tell {what}; the cloud has: {there}")
        name = known
    values = cloud.attributes[name]
    if values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
        raise InputError(f"attribute {name!r} cannot tell {what}: it is not one number per point")
    return values.astype(np.float64)
