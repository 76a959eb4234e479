"""The entry to this package: `settle` decides which method chooses the signs, and says why.

`auto` takes the first of these that applies:
1. a viewpoint, attributes or a trajectory that the user gives;
2. a file that knows its sensor (`sensors.file_sensors`);
3. open surfaces that look as if a camera at the origin had taken them: towards the origin;
4. a wide, flat, mostly level cloud is terrain (`terrain`), unless it is closed and may be a room, or was seen from
   below: up;
5. open surfaces of which the origin, named by a PCD file, sees one side throughout: towards the origin;
6. a cloud that was rather scanned from inside, as rooms and streets are, than from outside (`inside`): inward;
7. closed surfaces: outward;
8. open surfaces whose borders show from where an object was seen (`single_view`): towards that side;
9. else the best guess, with a warning.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import ShapeError, UsageError
from jetnormal.geometry.scale import unit_scale
from jetnormal.orientation.auto import decide
from jetnormal.orientation.decision import Decision, decided
from jetnormal.orientation.methods import Method, Orientation, choose_signs
from jetnormal.orientation.sensors import SensorOptions, Sensors, file_sensors, told_sensors

Floats = NDArray[np.float64]

FARTHEST = 1e150  # of a sensor, in units of the cloud's size: squares must be finite


class SignOptions(SensorOptions, Protocol):
    """The options that say how signs are chosen (`jobs.options.NormalOptions`)."""

    @property
    def orient(self) -> str: ...


@dataclass(frozen=True)
class SignChoice:
    """The options of `orient`, as those of `jetnormal.estimate`."""

    orient: str = "auto"
    viewpoint: tuple[float, float, float] | None = None
    viewpoint_attribute: tuple[str, str, str] | None = None
    trajectory: str | None = None
    time_attribute: str = "gps_time"


def find_sensors(options: SignOptions, cloud: Cloud) -> Sensors | None:
    """Find what is known of the sensor; None if nothing is, or it is not asked for.

    Raises:
        InputError: the cloud lacks the attributes of the viewpoints, or the trajectory does not fit it.
        UsageError: a viewpoint is needed, and none is known.
    """
    told = told_sensors(options, cloud)
    if told is not None or options.orient not in ("auto", "viewpoint"):
        return told
    found = file_sensors(cloud)
    if found is not None or options.orient == "auto":
        return found
    known = cloud.source.viewpoint
    if known is None or not np.isfinite(known[:3]).all():
        raise UsageError("`orient=viewpoint` needs `viewpoint`: the file does not tell one")
    return Sensors(np.asarray(known[:3], dtype=np.float64), "the file tells its viewpoint")


def settle(
    points: Floats,
    normals: NDArray[Any],
    asked: str,
    sensors: Sensors | None,
    source: Source,
    *,
    copies: bool = False,
) -> tuple[Orientation, Decision]:
    """Settle the signs of normals.

    Args:
        points: (N, 3), finite.
        normals: (N, 3) of any sign.
        asked: the option `orient`.
        sensors: of these points (`find_sensors`).
        source: what their file says of itself.
        copies: whether some points may be copies of others.
    """
    points, exponent = unit_scale(points)
    if sensors is not None:
        with np.errstate(over="ignore"):
            places = np.clip(np.ldexp(sensors.places, exponent), -FARTHEST, FARTHEST)
        orientation = choose_signs(points, normals, "viewpoint", viewpoint=places)
        unseen = 0 if places.ndim == 1 else int((~np.isfinite(places).all(axis=1)).sum())
        return orientation, replace(decided(orientation, asked, "viewpoint", sensors.reason), unseen=unseen)
    if asked == "auto":
        return decide(points, normals, source, copies=copies)
    orientation = choose_signs(points, normals, asked)  # type: ignore[arg-type]
    return orientation, decided(orientation, asked, asked, "it was asked for")


def orient(
    points: NDArray[Any] | Cloud,
    normals: NDArray[Any] | None = None,
    method: Method | str = "auto",
    *,
    viewpoint: ArrayLike | None = None,
    viewpoint_attribute: tuple[str, str, str] | None = None,
) -> NDArray[Any]:
    """Give normals consistent signs, decided as in `jetnormal.estimate`; their directions stay the same bit for bit.

    Args:
        points: (N, 3) coordinates, or a cloud, whose file may know its sensor.
        normals: (N, 3) directions of any length and sign; None takes the cloud's.
        method: "auto" (`settle`), or one of `orientation.methods.choose_signs`.
        viewpoint: the sensor's (x, y, z), or one for each point, (N, 3).
        viewpoint_attribute: names of a cloud's attributes that hold the sensor's position for each point.

    Returns:
        (N, 3) new array of the normals' dtype. Rows without a finite point and a direction stay as they are.

    Raises:
        ShapeError: points and normals do not match, or there are no normals.
        InputError, UsageError: as `find_sensors`.
    """
    cloud = points if isinstance(points, Cloud) else Cloud(np.asarray(points, dtype=np.float64))
    given = cloud.normals if normals is None else np.asarray(normals)
    if given is None or given.shape != cloud.points.shape:
        raise ShapeError(f"{len(cloud)} points need normals of the same shape, (N, 3)")
    place = None if viewpoint is None else np.asarray(viewpoint, dtype=np.float64)
    if place is not None and place.ndim == 2:
        cloud = replace(cloud, source=replace(cloud.source, sensors=place))
    single = None if place is None or place.ndim == 2 else (float(place[0]), float(place[1]), float(place[2]))
    options = SignChoice(str(method), single, viewpoint_attribute)
    sensors = find_sensors(options, cloud)
    rows = np.flatnonzero(cloud.valid)
    known = None if sensors is None else sensors.of(rows)
    result = given.copy()
    found, _ = settle(cloud.points[rows], given[rows], options.orient, known, cloud.source, copies=True)
    result[rows] = found.normals
    return result
