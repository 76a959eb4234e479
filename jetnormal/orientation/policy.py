"""The entry to this package: `settle` decides which method chooses the signs, and says why.

`auto` takes the first of these that applies:
1. a viewpoint, attributes or a trajectory that the user gives;
2. a file that knows its sensor (`sensors.file_sensors`);
3. open surfaces that look as if a camera at the origin had taken them: towards the origin;
4. a wide, flat, mostly level cloud is terrain (`terrain`), unless it is closed and may be a room: up;
5. open surfaces of which the origin, named by a PCD file, sees one side throughout: towards the origin;
6. a cloud that was rather scanned from inside, as rooms and streets are, than from outside (`inside`): inward;
7. closed surfaces: outward;
8. open surfaces whose borders show from where an object was seen (`single_view`): towards that side;
9. else the best guess, with a warning.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import ShapeError, UsageError
from jetnormal.geometry.scale import unit_scale
from jetnormal.orientation.calibration import probability
from jetnormal.orientation.methods import Method, Orientation, choose_signs
from jetnormal.orientation.sensors import SensorOptions, Sensors, file_sensors, told_sensors

Floats = NDArray[np.float64]

ONE_SIDE = 0.97  # of the open points: a surface that a sensor saw shows it one side
ENOUGH = 1_000_000  # points; from more, "auto" takes so many to decide by
FARTHEST = 1e150  # of a sensor, in units of the cloud's size: squares must be finite
# Probabilities that a cloud was scanned from inside, from which on a warning says so, normals look inward, and no
# warning is needed.
SUSPECT, RATHER, CERTAIN = 0.25, 0.5, 0.95
OPEN_SHARE = 0.05  # of the points; below it, they are specks beside a closed surface


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


@dataclass(frozen=True)
class Decision:
    """How the signs were settled.

    Attributes:
        asked: the option `orient`.
        used: the method: "viewpoint", "terrain", "global", "inside", "origin", "view", "mst", "up" or "none".
        reason: why that method.
        open_share: of the points that lie on surfaces without an outside.
        confidence: mean of the signs' confidence.
        guessed: whether the side of open surfaces is a guess.
        unseen: points without a finite viewpoint; their normals look up.
        inside: the probability that the cloud was scanned from inside.
    """

    asked: str
    used: str
    reason: str
    open_share: float = 0.0
    confidence: float = 0.0
    guessed: bool = field(default=False, repr=False)
    unseen: int = field(default=0, repr=False)
    inside: float = field(default=0.0, repr=False)

    def facts(self) -> dict[str, Any]:
        """What a summary in JSON says."""
        values = asdict(self)
        return {name: values[name] for name in ("asked", "used", "reason", "open_share", "confidence")}

    def warnings(self) -> list[str]:
        """What a user should know."""
        found = []
        if self.guessed:
            found.append(
                f"{self.open_share:.0%} of the points lie on open surfaces, which have no outside, and nothing tells "
                "which side was seen: their normals may all look the wrong way; `viewpoint` or `orient` settles it"
            )
        if self.used == "inside" and self.inside < CERTAIN:
            found.append(
                f"it looks like a room or street that was scanned from inside (probability {self.inside:.0%}), and its "
                "normals look inward: for an object, `orient=global` turns them outward"
            )
        elif self.used != "inside" and self.inside >= SUSPECT and not self.guessed:
            found.append(
                f"it may be a room or street that was scanned from inside (probability {self.inside:.0%}): then its "
                "normals all look the wrong way, and `viewpoint`, any place inside, turns them"
            )
        if self.unseen:
            found.append(f"{self.unseen} points have no finite viewpoint; their normals look up")
        return found


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
        return orientation, replace(_decision(orientation, asked, "viewpoint", sensors.reason), unseen=unseen)
    if asked == "auto":
        if len(points) <= ENOUGH:
            return _by_evidence(points, normals, source)
        return _by_part(points, normals, source, copies)
    orientation = choose_signs(points, normals, asked)  # type: ignore[arg-type]
    return orientation, _decision(orientation, asked, asked, "it was asked for")


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


def _by_evidence(points: Floats, normals: NDArray[Any], source: Source) -> tuple[Orientation, Decision]:
    """Decide by the shape of the cloud alone."""
    from jetnormal.orientation.inside import inside_probability
    from jetnormal.orientation.terrain import is_terrain
    from jetnormal.orientation.visibility import taken_from_origin

    orientation = choose_signs(points, normals, "view")
    is_open, view = orientation.open, orientation.view
    open_share = float(is_open.mean()) if len(is_open) else 0.0
    mostly_open = open_share > OPEN_SHARE
    if mostly_open and taken_from_origin(points):
        orientation = _towards_origin(points, orientation)
        reason = "its surfaces look as if a camera at the origin had taken them"
        return orientation, _decision(orientation, "auto", "origin", reason)
    seen = mostly_open and view is not None and view.certain
    inside = inside_probability(points, _unit(orientation.normals), open_share)
    if not seen and (mostly_open or inside < SUSPECT) and is_terrain(points, _unit(normals)):
        orientation = choose_signs(points, normals, "terrain")
        return orientation, _decision(orientation, "auto", "terrain", "the cloud is wide, flat and mostly level")
    if mostly_open and source.viewpoint is not None and _one_sided(points, orientation):
        orientation = _towards_origin(points, orientation)
        reason = "the file names the origin, which sees one side of its surfaces throughout"
        return orientation, _decision(orientation, "auto", "origin", reason)
    if inside >= RATHER:
        return _inward(points, normals, inside)
    orientation = replace(orientation, confidence=_unless(inside, orientation.confidence))
    return orientation, replace(_from_outside(orientation, mostly_open), inside=inside)


def _inward(points: Floats, normals: NDArray[Any], inside: float) -> tuple[Orientation, Decision]:
    """Turn a cloud that was scanned from inside, with a probability, to places there."""
    orientation = choose_signs(points, normals, "inside")
    orientation = replace(orientation, confidence=_unless(1 - inside, orientation.confidence))
    reason = f"it was scanned from inside (probability {inside:.0%}); `orient=global` turns it outward"
    return orientation, replace(_decision(orientation, "auto", "inside", reason), inside=inside)


def _from_outside(orientation: Orientation, mostly_open: bool) -> Decision:
    """How the signs of "view" came about."""
    if not mostly_open:
        return _decision(orientation, "auto", "global", "its surfaces are closed")
    view, share = orientation.view, f"{orientation.open.mean():.0%} of the points lie on open surfaces"
    if view is not None and view.certain:
        return _decision(orientation, "auto", "view", f"{share}, whose borders lean away from there")
    if view is None:
        used, reason = "global", "up where open"
    elif view.several:
        used, reason = "global", "seen from several sides, outward"
    else:
        used, reason = "view", "whose borders lean a little away from it"
    return replace(_decision(orientation, "auto", used, f"a guess: {share}, {reason}"), guessed=True)


def _unless(wrong: float, confidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """The probability that each sign is right (N,), if all may be wrong with a probability."""
    mixed = confidence * (1 - wrong) + (1 - confidence) * wrong
    return np.where(confidence > 0, mixed, 0).astype(np.float32)


def _by_part(points: Floats, normals: NDArray[Any], source: Source, copies: bool) -> tuple[Orientation, Decision]:
    """Decide by the shape of the thinned cloud, whose signs are carried to all points.

    What is open, or how borders lean, depends on how dense a cloud is. Clouds in tiles are thinned to the same points.
    """
    from jetnormal.geometry.neighbors import distinct
    from jetnormal.geometry.thinning import least, ranks
    from jetnormal.orientation.carrying import Thinned, carry_in_blocks

    directions = _unit(normals).astype(np.float32)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1) & directions.any(axis=1))
    first, copy_of = distinct(points[rows]) if copies else (np.arange(len(rows)),) * 2
    if len(first) < len(points):
        points, directions = points[rows[first]], directions[rows[first]]
    part = least(ranks(points, points[:0]), ENOUGH)
    told, decision = _by_evidence(points[part], directions[part], source)
    thinned = Thinned(points[part], told.normals, told.confidence.astype(np.float64))
    flips, sure = carry_in_blocks(points, directions, thinned)
    directions[flips] *= -1
    turned, confidence = normals.copy(), np.zeros(len(normals), np.float32)
    turned[rows[np.einsum("nd,nd->n", normals[rows], directions[copy_of]) < 0]] *= -1  # copies follow the first one
    confidence[rows] = sure[copy_of]
    is_open = np.zeros(len(normals), dtype=np.bool_)
    is_open[rows[first[part]]] = told.open
    orientation = Orientation(turned, confidence, is_open, told.view)
    return orientation, replace(decision, confidence=round(float(confidence.mean()), 4))


def _one_sided(points: Floats, orientation: Orientation) -> bool:
    """Whether the origin sees one side of the consistently signed open surfaces, as a sensor would."""
    facing = np.einsum("nd,nd->n", orientation.normals, points)[orientation.open] < 0
    return bool(max(facing.mean(), 1 - facing.mean()) >= ONE_SIDE)


def _towards_origin(points: Floats, orientation: Orientation) -> Orientation:
    """Turn open surfaces towards the origin, where a depth camera stands in its own frame."""
    along = np.einsum("nd,nd->n", orientation.normals, points)
    away = orientation.open & (along > 0)
    cosine = np.abs(along) / np.maximum(
        np.linalg.norm(points, axis=1) * np.linalg.norm(orientation.normals, axis=1), 1e-300
    )
    return replace(
        orientation,
        normals=np.where(away[:, None], -orientation.normals, orientation.normals),
        confidence=np.where(orientation.open, probability(cosine, "sight"), orientation.confidence).astype(np.float32),
    )


def _decision(orientation: Orientation, asked: str, used: str, reason: str) -> Decision:
    count = max(1, len(orientation.open))
    share, confidence = float(orientation.open.sum() / count), float(orientation.confidence.sum() / count)
    return Decision(asked, used, reason, round(share, 4), round(confidence, 4))


def _unit(normals: NDArray[Any]) -> Floats:
    """Unit vectors (N, 3); 0 where there is no direction."""
    with np.errstate(invalid="ignore"):
        length = np.linalg.norm(normals, axis=1, keepdims=True)
    usable = np.isfinite(length) & (length > 0)
    return np.divide(normals, length, out=np.zeros(normals.shape), where=usable)
