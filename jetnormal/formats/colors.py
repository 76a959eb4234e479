"""Colors of points: those in a file, and those that show normals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud
from jetnormal.formats.storage import COLORS, unpack_colors


def point_colors(cloud: Cloud) -> NDArray[np.float64] | None:
    """Return the cloud's own colors, (N, 3) from 0 to 1, or None.

    They are the attributes red, green and blue, or PCL's packed rgb or rgba. Whole numbers reach up to what their
    type holds, those of wider types than 16 bits to 255, and so do those of 16 bits where none exceeds 255, as many
    programs store bytes in LAS files; fractions reach up to 1, or to 255 where any exceeds 1.
    """
    channels = unpack_colors(cloud.attributes)
    if not len(cloud) or any(name not in channels or channels[name].ndim != 1 for name in COLORS):
        return None
    colors = np.stack([channels[name] for name in COLORS], axis=1)
    if colors.dtype.kind not in "uif":
        return None
    if colors.dtype.kind == "u" and colors.dtype.itemsize <= 2:
        full = float(np.iinfo(colors.dtype).max) if colors.max() > 255 else 255.0
    else:
        full = 1.0 if colors.dtype.kind == "f" and np.nanmax(colors) <= 1 else 255.0
    return np.clip(np.nan_to_num(colors.astype(np.float64)) / full, 0, 1)


def normal_colors(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the usual code for directions (N, 3): x in red, y in green, z in blue, from -1 at 0 to 1 at 1."""
    return np.clip(0.5 + 0.5 * normals, 0, 1)
