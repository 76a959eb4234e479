"""From a cloud to a mesh.

normals, from the file or estimated -> Poisson surface -> trimmed where it is open -> cleaned -> colored
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, UsageError
from jetnormal.formats.meshes import check_mesh_target, write_mesh
from jetnormal.formats.ply import PlyExtra
from jetnormal.jobs.estimate import MAX_COORDINATE, EstimateOptions, Vector, estimate_cloud, prepare_estimator
from jetnormal.mesh import Mesh
from jetnormal.orientation.policy import check_sign_options
from jetnormal.support.report import StageTimer, logger, peak_memory_mb

MIN_POINTS = 10  # fewer suggest no surface
DEPTHS = (4, 12)  # of the octree: 16 to 4096 cells along a side
FLATNESS = 1e-9  # the second extent of a cloud over its first, below which it is a line
LENGTH_TOLERANCE = 0.01  # in which the length of a unit normal may differ from 1
MAX_DISAGREEMENT = 0.1  # share of neighbors with opposite normals
# An open surface is cut where the density falls below that of nearly all its vertices among the points.
OPEN_TRIM_PERCENTILE = 2.0


@dataclass(frozen=True)
class ReconstructOptions:
    """How a mesh is made.

    Attributes:
        depth: of Poisson's octree, 4 to 12; None takes the one whose cells are as large as the points are apart.
        scale: side of the cube that Poisson solves for over the longest side of the points' box, at least 1.
        trim: share of the mesh's vertices to cut off where the points are sparsest, 0 (none) to less than 1. None
            leaves a closed surface whole and cuts an open one where its points end. A surface is open if more
            than 2 % of its area is farther from all points than three times the radius around the nearest of them
            that holds eight others.
        recompute: whether normals are estimated even if the cloud has some.
        model: what estimates normals, as in `EstimateOptions`.
        orient: how their signs are chosen, as in `EstimateOptions`, but not "none".
        viewpoint, viewpoint_attribute: where the sensor was, as in `EstimateOptions`.
        device: "auto", "cpu", "cuda" or "cuda:N", for the estimate.
        threads: CPU threads; None for all cores. On one, the same cloud gives the same mesh bit for bit; on more,
            the order of its vertices changes.
        force: whether an existing output is overwritten.
    """

    depth: int | None = None
    scale: float = 1.1
    trim: float | None = None
    recompute: bool = False
    model: str = "auto"
    orient: str = "auto"
    viewpoint: Vector | None = None
    viewpoint_attribute: tuple[str, str, str] | None = None
    device: str = "auto"
    threads: int | None = None
    force: bool = False

    def __post_init__(self) -> None:
        low, high = DEPTHS
        if self.depth is not None and not low <= self.depth <= high:
            raise UsageError(f"the depth is {low} to {high}, not {self.depth}")
        if not 1 <= self.scale <= 10:
            raise UsageError(f"the scale is 1 to 10, not {self.scale}")
        if self.trim is not None and not 0 <= self.trim < 1:
            raise UsageError(f"trim is a share, 0 to less than 1, not {self.trim}")
        if self.orient == "none":
            raise UsageError("a surface needs to know outside from inside: leave --orient none out")
        check_sign_options(self.for_normals)

    @property
    def for_normals(self) -> EstimateOptions:
        """How normals are estimated."""
        return EstimateOptions(
            model=self.model,
            orient=self.orient,
            viewpoint=self.viewpoint,
            viewpoint_attribute=self.viewpoint_attribute,
            device=self.device,
            threads=self.threads,
        )


def reconstruct(points: NDArray[Any] | Cloud, **options: Any) -> Mesh:
    """Makes a mesh from points: screened Poisson reconstruction (Kazhdan and Hoppe, 2013).

    Args:
        points: (N, 3) coordinates, or a cloud, whose normals and colors are used if it has them.
        **options: the fields of `ReconstructOptions`, such as `depth=9` or `trim=0`.

    Returns:
        The mesh, in the coordinates of the points, with their colors.

    Raises:
        InputError: fewer than ten different points with a normal, or all of them on one line.
        UsageError: an option is out of range or contradicts another.
        ModelError: there is no such model.
        ResourceError: the device is not there, Open3D is not there, or its solver fails.
    """
    cloud = points if isinstance(points, Cloud) else Cloud(np.asarray(points, dtype=np.float64))
    return _reconstruct_cloud(cloud, ReconstructOptions(**options), StageTimer())[0]


def reconstruct_file(source: Path, target: Path, options: ReconstructOptions) -> dict[str, Any]:
    """Reads a cloud, makes a mesh of it and writes that.

    Args:
        source: the cloud.
        target: the mesh; its suffix tells the format (`formats.meshes`).
        options: how.

    Returns:
        A summary: input, output, points, normals ("file" or the model), orient (None for normals of the file),
        depth, open, trimmed (share of the area that was cut off), vertices, faces, components, watertight, seconds
        (by stage), peak_memory_mb (without the solver's process), warnings.

    Raises:
        InputError: a file cannot be read or written, or as `reconstruct`.
        UsageError, ModelError, ResourceError: as `reconstruct`.
    """
    timer = StageTimer()
    check_mesh_target(target, overwrite=options.force)
    with timer.stage("read"):
        cloud = formats.read(source)
    try:
        mesh, facts = _reconstruct_cloud(cloud, options, timer)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    with timer.stage("write"):
        notes = [f"{source}: {note}" for note in cloud.source.notes]
        warnings = notes + facts.pop("warnings") + write_mesh(mesh, target, overwrite=options.force)
    return {
        "input": str(source),
        "output": str(target),
        "points": len(cloud),
        **facts,
        "seconds": {name: round(seconds, 3) for name, seconds in timer.seconds.items()},
        "peak_memory_mb": peak_memory_mb(),
        "warnings": warnings,
    }


def _reconstruct_cloud(cloud: Cloud, options: ReconstructOptions, timer: StageTimer) -> tuple[Mesh, dict[str, Any]]:
    """The mesh, and what the summary says of it."""
    from jetnormal.formats.colors import point_colors
    from jetnormal.geometry.neighbors import distinct
    from jetnormal.meshing import cleanup as surface
    from jetnormal.meshing.poisson import poisson

    cloud, facts = _with_normals(cloud, options, timer)
    facts["warnings"] = _faces_of(cloud) + facts["warnings"]
    points, normals = cloud.points, cloud.normals
    assert normals is not None
    rows = np.flatnonzero(cloud.valid & (np.nan_to_num(normals, posinf=0, neginf=0) != 0).any(axis=1))
    rows = rows[distinct(points[rows])[0]]
    points, normals = points[rows], normals[rows]
    _check_extent(points)
    if facts["orient"] is None:
        facts["warnings"] += _doubts(points, normals)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    centre, size = (points.min(axis=0) + points.max(axis=0)) / 2, float(np.ptp(points, axis=0).max())
    points = (points - centre) / size  # the solver has single precision
    depth = options.depth or _fitting_depth(points, options.scale)
    logger.info("reconstructing %s points at depth %d", f"{len(points):,}", depth)
    with timer.stage("reconstruct"):
        vertices, faces, density = poisson(points, normals, depth, scale=options.scale, threads=options.threads)
    if not len(faces):
        raise InputError("the points and their normals suggest no surface; are the normals consistent?")
    with timer.stage("finish"):
        mesh, is_open, trimmed = _trimmed(Mesh(vertices, faces), density, points, options.trim)
        mesh = surface.without_specks(surface.cleaned(mesh), points)
        if not len(mesh.faces):
            raise InputError("trimming left nothing of the surface; give a smaller --trim")
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
    return replace(mesh, vertices=mesh.vertices * size + centre), facts


def _with_normals(cloud: Cloud, options: ReconstructOptions, timer: StageTimer) -> tuple[Cloud, dict[str, Any]]:
    """The cloud with its own normals or estimated ones, and normals, orient and warnings of the summary."""
    asked = options.for_normals
    if cloud.normals is None or options.recompute:
        with timer.stage("model"):
            estimator = prepare_estimator(asked)
        found, facts = estimate_cloud(cloud, asked, estimator, timer)
        return found, {"normals": facts["model"], "orient": facts["orient"], "warnings": facts["warnings"]}
    length = np.linalg.norm(cloud.normals, axis=1)
    usable = cloud.valid & np.isfinite(length) & (length > 0)
    if not usable.any():
        raise InputError("none of its normals has a direction; --recompute estimates new ones")
    warnings = []
    if not usable.all():
        warnings.append(f"{np.sum(~usable)} points without finite coordinates or a normal are left out")
    if (np.abs(length[usable] - 1) > LENGTH_TOLERANCE).any():
        warnings.append("the normals are not of length 1; their directions are used")
    if asked != EstimateOptions(device=asked.device, threads=asked.threads):
        warnings.append("the cloud has normals, which are used as they are; --recompute estimates new ones")
    return cloud, {"normals": "file", "orient": None, "warnings": warnings}


def _faces_of(cloud: Cloud) -> list[str]:
    """A warning if the file is a mesh."""
    elements = cloud.source.extra.elements if isinstance(cloud.source.extra, PlyExtra) else ()
    count = sum(element.count for element in elements if element.name in ("face", "tristrips"))
    return [f"the file is a mesh already: its {count} faces are not used, only its vertices"] if count else []


def _check_extent(points: NDArray[np.float64]) -> None:
    if len(points) < MIN_POINTS:
        raise InputError(f"{len(points)} different points with a normal: a surface needs at least {MIN_POINTS}")
    largest = float(np.abs(points).max())
    if largest > MAX_COORDINATE:
        raise InputError(f"coordinates as large as {largest:.3g} cannot be computed with; remove those points")
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] <= FLATNESS * extents[0]:
        raise InputError("all points lie on one line: they suggest no surface")


def _doubts(points: NDArray[np.float64], normals: NDArray[np.float64]) -> list[str]:
    """A warning if many neighbors have opposite normals: nothing good comes of such signs."""
    from jetnormal.geometry.neighbors import NeighborIndex

    neighbors = NeighborIndex(points).query(points, 5)[0][:, 1:]
    opposite = np.einsum("nd,nkd->nk", normals, normals[neighbors]) < 0
    if opposite.mean() <= MAX_DISAGREEMENT:
        return []
    return [f"{100 * opposite.mean():.0f} % of neighbors have opposite normals; --recompute estimates consistent ones"]


def _fitting_depth(points: NDArray[np.float64], scale: float) -> int:
    """The depth at which the cells are no larger than the points, in a box of longest side 1, are apart."""
    from jetnormal.meshing.cleanup import typical_spacing

    return int(np.clip(np.ceil(np.log2(scale / typical_spacing(points))), *DEPTHS))


def _trimmed(
    mesh: Mesh, density: NDArray[np.float64], points: NDArray[np.float64], trim: float | None
) -> tuple[Mesh, bool, float]:
    """The mesh without what the points do not support, whether its surface is open, and the share of area cut off."""
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
