"""What settles the signs of a cloud's normals: the user's options, what the file knows, and what to say about it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, UsageError
from jetnormal.orientation.methods import Method, Orientation, default_method

ONE_SIDE = 0.97  # of the open points: a surface that a sensor saw shows it one side
OPEN_SHARE = 0.05  # of the points; below it, they are specks beside a closed surface


class SignOptions(Protocol):
    """The options that say how signs are chosen (`jobs.options.NormalOptions`), which contradict no other."""

    @property
    def orient(self) -> str: ...
    @property
    def viewpoint(self) -> tuple[float, float, float] | None: ...
    @property
    def viewpoint_attribute(self) -> tuple[str, str, str] | None: ...


def sign_method(options: SignOptions, cloud: Cloud) -> tuple[Method, NDArray[np.float64] | None]:
    """The method that settles the signs and, for "viewpoint", where from: (3,), or one for each point (N, 3).

    Raises:
        InputError: the cloud lacks an attribute that is to tell the viewpoints.
        UsageError: a viewpoint is needed, and nothing tells it.
    """
    if options.viewpoint_attribute is not None:
        return "viewpoint", _viewpoints(options.viewpoint_attribute, cloud)
    if options.viewpoint is not None:
        return "viewpoint", np.asarray(options.viewpoint, dtype=np.float64)
    sensors = cloud.source.sensors
    if sensors is not None and options.orient in ("auto", "viewpoint"):
        return "viewpoint", sensors
    known = cloud.source.viewpoint
    method: Any = default_method(known) if options.orient == "auto" else options.orient
    if method != "viewpoint":
        return method, None
    if known is None or not np.isfinite(known[:3]).all():
        raise UsageError("`orient=viewpoint` needs `viewpoint`: the file does not tell one")
    return method, np.asarray(known[:3], dtype=np.float64)


def seen_from_origin(
    orientation: Orientation, points: NDArray[np.float64], options: SignOptions, cloud: Cloud
) -> Orientation | None:
    """Open surfaces turned towards the origin, if it is plausible that a sensor stood there.

    The origin is where a depth camera stands in its own frame, and it is the VIEWPOINT that writers of PCD files put
    where they know none. Where nothing better is known, such a VIEWPOINT is believed if consistent signs show it one
    side of the surfaces, and any file's origin if the surfaces look as if a camera had taken them from there.

    Args:
        orientation: of the points, by "global".
        points: (N, 3).
        options: of the user.
        cloud: that the points come from.

    Returns:
        The orientation with these signs; None where they do not apply.
    """
    from jetnormal.orientation.visibility import taken_from_origin

    known, is_open = cloud.source.viewpoint, orientation.open
    elsewhere = known is not None and any(known[:3])
    if elsewhere or options.orient != "auto" or is_open.mean() <= OPEN_SHARE:
        return None
    facing = np.einsum("nd,nd->n", orientation.normals, -points) > 0
    share = float(facing[is_open].mean())
    stated = known is not None and max(share, 1 - share) >= ONE_SIDE
    if not stated and not taken_from_origin(points):
        return None
    normals = np.where((is_open & ~facing)[:, None], -orientation.normals, orientation.normals)
    return replace(orientation, normals=normals)


def sign_reason(options: SignOptions, cloud: Cloud, method: Method, from_origin: bool) -> str:
    """Say in one line why a method chose the signs.

    Args:
        options: of the user.
        cloud: whose normals they are.
        method: what `sign_method` took.
        from_origin: whether `seen_from_origin` applies.
    """
    if options.viewpoint_attribute is not None:
        return f"the attributes {', '.join(options.viewpoint_attribute)} tell where each point was seen from"
    if options.viewpoint is not None:
        return "a viewpoint was given"
    if method == "viewpoint":
        what = "where each point was seen from" if cloud.source.sensors is not None else "where its sensor stood"
        return f"the file tells {what}"
    if options.orient != "auto":
        return "it was asked for"
    if from_origin:
        return "no viewpoint is known; open surfaces look to the origin, where a sensor seems to have stood"
    return "no viewpoint is known: outward"


def sign_warnings(orientation: Orientation, viewpoint: NDArray[np.float64] | None, from_origin: bool) -> list[str]:
    """What a user should know about the signs."""
    warnings = []
    share = float(orientation.open.mean()) if len(orientation.open) else 0.0
    if share > OPEN_SHARE:
        side = "towards the origin, where their sensor seems to have stood" if from_origin else "up"
        warnings.append(
            f"{share:.0%} of the points lie on open surfaces, which have no outside: their normals look {side}; "
            "`viewpoint` tells which side was seen"
        )
    unseen = 0 if viewpoint is None or viewpoint.ndim == 1 else int((~np.isfinite(viewpoint).all(axis=1)).sum())
    if unseen:
        warnings.append(f"{unseen} points have no finite viewpoint; their normals look up")
    return warnings


def _viewpoints(names: tuple[str, str, str], cloud: Cloud) -> NDArray[np.float64]:
    for name in names:
        if name not in cloud.attributes:
            there = ", ".join(cloud.attributes) or "none"
            raise InputError(f"there is no attribute {name!r} to tell the viewpoints; the cloud has: {there}")
        values = cloud.attributes[name]
        if values.ndim != 1 or not np.issubdtype(values.dtype, np.number):
            raise InputError(f"attribute {name!r} cannot tell viewpoints: it is not one number per point")
    return np.stack([cloud.attributes[name].astype(np.float64) for name in names], axis=1)
