"""From a cloud to a mesh.

normals, from the file or estimated -> Poisson surface -> trimmed where it is open -> cleaned -> colored
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.cloud import Cloud, check_coordinates
from jetnormal.errors import InputError
from jetnormal.formats.meshes import check_mesh_target, gltf_offset, write_mesh
from jetnormal.formats.ply import PlyExtra
from jetnormal.jobs.estimate import find_normals
from jetnormal.jobs.files import check_format, read_file
from jetnormal.jobs.options import DEPTHS, ReadOptions, ReconstructOptions
from jetnormal.jobs.prediction import prepare_estimator
from jetnormal.mesh import Mesh
from jetnormal.support.open3d_loader import require_open3d
from jetnormal.support.report import StageTimer, logger, peak_memory_mb

MIN_POINTS = 10  # fewer suggest no surface
FLATNESS = 1e-9  # the second extent of a cloud over its first, below which it is a line
LENGTH_TOLERANCE = 0.01  # in which the length of a unit normal may differ from 1
MAX_DISAGREEMENT = 0.1  # share of neighbors with opposite normals
# An open surface is cut where the density falls below that of nearly all its vertices among the points.
OPEN_TRIM_PERCENTILE = 2.0
NOISE_CELLS = 4.0  # of the noise in a cell, by default
FRAME_NOISE = 0.75  # quantile of the noise in the frame of a depth camera that decides
FOR_NORMALS = ("model", "k", "order", "iterations", "orient", "viewpoint", "viewpoint_attribute", "trajectory")


def reconstruct_file(
    source: Path,
    target: Path,
    options: ReconstructOptions,
    files: ReadOptions = ReadOptions(),  # noqa: B008 - frozen
    *,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Read a cloud, make a mesh of it and write that.

    Args:
        source: the cloud, or "-" for standard input.
        target: the mesh; its suffix tells the format (`formats.meshes`).
        options: how.
        files: how the cloud is read.
        overwrite: whether an existing output may be replaced.

    Returns:
        A summary: input, output, points, normals ("file" or the model), orient (None for normals of the file),
        depth, open, trimmed (share of the area that was cut off), vertices, faces, components, watertight, offset (what
        was taken off the coordinates for GLB, or None), seconds (by stage), peak_memory_mb (without the solver's
        process), warnings.

    Raises:
        InputError: a file cannot be read or written, or as `jetnormal.reconstruct`.
        UsageError, ModelError, ResourceError: as `jetnormal.reconstruct`.
    """
    timer = StageTimer()
    check_format(files, source)
    check_mesh_target(target, overwrite=overwrite)
    with timer.stage("read"):
        cloud = read_file(source, files)
    try:
        mesh, facts = reconstruct_cloud(cloud, options, timer)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    with timer.stage("write"):
        notes = [f"{source}: {note}" for note in cloud.source.notes]
        warnings = notes + facts.pop("warnings") + write_mesh(mesh, target, overwrite=overwrite)
    offset = gltf_offset(mesh) if target.suffix.lower() == ".glb" else None
    return {
        "input": str(source),
        "output": str(target),
        "points": len(cloud),
        **facts,
        "offset": offset,
        "seconds": timer.seconds,
        "peak_memory_mb": peak_memory_mb(),
        "warnings": warnings,
    }


def reconstruct_cloud(cloud: Cloud, options: ReconstructOptions, timer: StageTimer) -> tuple[Mesh, dict[str, Any]]:
    """Make a mesh of a cloud; return it, and what the summary says of it.

    Raises:
        InputError, UsageError, ModelError, ResourceError: as `jetnormal.reconstruct`.
    """
    from jetnormal.formats.colors import point_colors
    from jetnormal.meshing import cleanup as surface
    from jetnormal.meshing.poisson import poisson

    require_open3d("reconstructs surfaces")  # before the normals, which take longer
    cloud, facts = _with_normals(cloud, options, timer)
    facts["warnings"] = _faces_of(cloud) + facts["warnings"]
    rows, normals = _oriented_points(cloud)
    points = cloud.points[rows]
    if facts["orient"] is None:
        facts["warnings"] += _doubts(points, normals)
    center, size = (points.min(axis=0) + points.max(axis=0)) / 2, float(np.ptp(points, axis=0).max())
    points = (points - center) / size  # the solver has single precision
    depth = options.depth or _fitting_depth(points, options.scale, (cloud.source.height or 1) > 1)
    logger.info("reconstructing %s points at depth %d", f"{len(points):,}", depth)
    with timer.stage("reconstruct"):
        vertices, faces, density = poisson(points, normals, depth, scale=options.scale, threads=options.threads)
    if not len(faces):
        raise InputError("the points and their normals suggest no surface; are the normals consistent?")
    with timer.stage("finish"):
        mesh, is_open, trimmed = _trimmed(Mesh(vertices, faces), density, points, options.trim)
        mesh = _finished(mesh, points, options)
        colors = point_colors(cloud)
        if colors is not None:
            mesh = replace(mesh, colors=surface.carried(colors[rows], points, mesh.vertices))
    facts |= {
        "depth": depth,
        "open": is_open,
        "trimmed": round(trimmed, 4),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "components": int(surface.component_labels(mesh).max()) + 1,
        "watertight": surface.is_watertight(mesh),
    }
    return replace(mesh, vertices=mesh.vertices * size + center), facts


def _oriented_points(cloud: Cloud) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The rows (M,) of a cloud's distinct points that have a normal, and their unit normals (M, 3).

    Raises:
        InputError: they suggest no surface.
    """
    from jetnormal.geometry.neighbors import distinct

    assert cloud.normals is not None
    directed = (np.nan_to_num(cloud.normals, posinf=0, neginf=0) != 0).any(axis=1)
    rows = np.flatnonzero(cloud.valid & directed)
    rows = rows[distinct(cloud.points[rows])[0]]
    _check_extent(cloud.points[rows])
    normals = cloud.normals[rows]
    return rows, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _with_normals(cloud: Cloud, options: ReconstructOptions, timer: StageTimer) -> tuple[Cloud, dict[str, Any]]:
    """The cloud with its own normals or estimated ones, and normals, orient and warnings of the summary."""
    if cloud.normals is None or options.recompute:
        with timer.stage("model"):
            estimator = prepare_estimator(options)
        result = find_normals(cloud, options, estimator, timer)
        facts = {"normals": result.model, "orient": result.decision.facts(), "warnings": [*result.warnings]}
        return replace(cloud, normals=result.normals), facts
    length = np.linalg.norm(cloud.normals, axis=1)
    usable = cloud.valid & np.isfinite(length) & (length > 0)
    if not usable.any():
        raise InputError("none of its normals has a direction; `recompute` estimates new ones")
    warnings = []
    if not usable.all():
        warnings.append(f"{np.sum(~usable)} points without finite coordinates or a normal are left out")
    if (np.abs(length[usable] - 1) > LENGTH_TOLERANCE).any():
        warnings.append("the normals are not of length 1; their directions are used")
    if any(getattr(options, name) != getattr(ReconstructOptions(), name) for name in FOR_NORMALS):
        warnings.append("the cloud has normals, which are used as they are; `recompute` estimates new ones")
    return cloud, {"normals": "file", "orient": None, "warnings": warnings}


def _faces_of(cloud: Cloud) -> list[str]:
    """A warning if the file is a mesh."""
    elements = cloud.source.extra.elements if isinstance(cloud.source.extra, PlyExtra) else ()
    count = sum(element.count for element in elements if element.name in ("face", "tristrips"))
    return [f"the file is a mesh already: its {count} faces are not used, only its vertices"] if count else []


def _check_extent(points: NDArray[np.float64]) -> None:
    if len(points) < MIN_POINTS:
        raise InputError(f"{len(points)} different points with a normal: a surface needs at least {MIN_POINTS}")
    check_coordinates(points)
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] <= FLATNESS * extents[0]:
        raise InputError("all points lie on one line: they suggest no surface")


def _doubts(points: NDArray[np.float64], normals: NDArray[np.float64]) -> list[str]:
    """A warning if many neighbors have opposite normals, which no usable surface follows from."""
    from jetnormal.geometry.neighbors import NeighborIndex

    neighbors = NeighborIndex(points).query(points, 5)[0][:, 1:]
    opposite = np.einsum("nd,nkd->nk", normals, normals[neighbors]) < 0
    if opposite.mean() <= MAX_DISAGREEMENT:
        return []
    return [f"{100 * opposite.mean():.0f} % of neighbors have opposite normals; `recompute` estimates consistent ones"]


def _fitting_depth(points: NDArray[np.float64], scale: float, is_frame: bool) -> int:
    """The depth at which a cell is no larger than the spacing of the points, in a box of longest side 1.

    If the noise is large against that, a cell is as large as four times the noise: smaller cells would show the layers
    and bumps of a depth camera as scales. In a frame of such a camera the noise grows with the distance, and that of
    the farther surfaces counts.
    """
    from jetnormal.geometry.neighbors import typical_spacing
    from jetnormal.meshing.cleanup import noise

    cell = max(typical_spacing(points), NOISE_CELLS * noise(points, FRAME_NOISE if is_frame else 0.5))
    return int(np.clip(np.ceil(np.log2(scale / cell)), *DEPTHS))


def _trimmed(
    mesh: Mesh, density: NDArray[np.float64], points: NDArray[np.float64], trim: float | None
) -> tuple[Mesh, bool, float]:
    """The mesh without the parts that no points support, whether its surface is open, and the share of area cut off."""
    from jetnormal.meshing import cleanup as surface

    remote = surface.remoteness(mesh.vertices, points)
    is_open = surface.gap_share(mesh, remote) > surface.OPEN_SHARE
    among = remote <= 1
    if trim is not None:
        threshold = float(np.quantile(density, trim)) if trim else -np.inf
    elif is_open and among.any():
        threshold = float(np.percentile(density[among], OPEN_TRIM_PERCENTILE))
    else:
        threshold = -np.inf
    kept = surface.clip(mesh, density, threshold)
    before, after = (np.linalg.norm(one.area_vectors(), axis=1).sum() for one in (mesh, kept))
    return kept, is_open, float(1 - after / before)


def _finished(mesh: Mesh, points: NDArray[np.float64], options: ReconstructOptions) -> Mesh:
    """The mesh cleaned, without specks and, if asked for, smoothed and simplified.

    Raises:
        InputError: nothing is left of it.
    """
    from jetnormal.meshing import cleanup as surface

    mesh = surface.without_specks(surface.cleaned(mesh), points, options.min_component)
    if not len(mesh.faces):
        raise InputError("trimming left nothing of the surface; give a smaller `trim`")
    if options.smooth:
        mesh = surface.smoothed(mesh, options.smooth)
    return mesh if options.faces is None else surface.simplified(mesh, options.faces)
