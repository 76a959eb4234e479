"""`jetnormal estimate`: one cloud in, the same cloud with normals out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from jetnormal.cli.derive import with_options
from jetnormal.cli.failures import spell
from jetnormal.cli.options import Json, Quiet, Verbose, set_verbosity
from jetnormal.errors import UsageError
from jetnormal.jobs.options import EstimateOptions, ReconstructOptions
from jetnormal.support.report import logger, print_json


@with_options
def estimate(
    input: Annotated[Path, typer.Argument(metavar="INPUT", help="Point cloud: .ply, .pcd or .xyz.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUTPUT", help="File to write: .ply, .pcd or .xyz.")
    ],
    options: EstimateOptions,
    encoding: Annotated[
        str | None,
        typer.Option(metavar="E", help="Encoding of the file, such as ascii.", show_default="the input's"),
    ] = None,
    mesh: Annotated[
        Path | None,
        typer.Option(metavar="MESH", help="Also make a mesh of OUTPUT, as jetnormal reconstruct does by default."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite OUTPUT and MESH where they exist.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Add an oriented unit normal to every point of a cloud.

    OUTPUT holds what INPUT holds (coordinates, colors, other attributes, the order of the points),
    and the normals.

    \b
    Examples:
      jetnormal estimate scan.ply -o scan_normals.ply
      jetnormal estimate scan.pcd -o scan.ply --model jet --k 32 --order 2
      jetnormal estimate room.ply -o room_normals.ply --viewpoint 0,0,1.6
      jetnormal estimate terrain.xyz -o terrain_normals.xyz --orient up
      jetnormal estimate part.ply -o part_normals.ply --curvature --json
      jetnormal estimate statue.ply -o statue_normals.ply --mesh statue.glb
    """
    set_verbosity(quiet, verbose)
    if mesh is not None:
        check_mesh(mesh, output, options.orient, force)
    from jetnormal.jobs.estimate import estimate_file

    summary = estimate_file(input, output, options, encoding=encoding, overwrite=force)
    report(summary)
    if mesh is not None:
        from jetnormal.jobs.reconstruct import reconstruct_file

        surface = ReconstructOptions(threads=options.threads)
        summary["mesh"] = reconstruct_file(output, mesh, surface, overwrite=force)
        report_mesh(summary["mesh"])
    if json:
        print_json(summary)


def check_mesh(mesh: Path, output: Path, orient: str, force: bool) -> None:
    """Find out before the long work whether a mesh can be made and written.

    Raises:
        UsageError: it would overwrite the cloud, or has no outside.
        InputError: it cannot be written.
    """
    from jetnormal.formats.meshes import check_mesh_target

    if mesh.resolve() == output.resolve():
        raise UsageError(f"{mesh}: the mesh would overwrite the cloud; give it a name of its own")
    if orient == "none":
        raise UsageError("a mesh needs to know outside from inside: leave `orient=none` out")
    check_mesh_target(mesh, overwrite=force)


def report_warnings(summary: dict[str, Any]) -> None:
    """Log what the user should know, in the words of the command line."""
    summary["warnings"] = [spell(warning) for warning in summary["warnings"]]
    for warning in summary["warnings"]:
        logger.warning("%s", warning)


def report_mesh(summary: dict[str, Any]) -> None:
    """Log what mesh was made, and what the user should know about it."""
    report_warnings(summary)
    count = summary["components"]
    logger.info(
        "wrote %s: %s vertices, %s faces, %d %s, %s (depth %d, normals: %s; %.1f s)",
        summary["output"],
        f"{summary['vertices']:,}",
        f"{summary['faces']:,}",
        count,
        "component" if count == 1 else "components",
        "watertight" if summary["watertight"] else "not watertight",
        summary["depth"],
        summary["normals"],
        sum(summary["seconds"].values()),
    )


def report(summary: dict[str, Any]) -> None:
    """Log what was done, and what the user should know about it."""
    report_warnings(summary)
    logger.info(
        "wrote %s: %s of %s points have normals (model %s, signs %s; %.1f s, %s points/s)",
        summary["output"],
        f"{summary['valid']:,}",
        f"{summary['points']:,}",
        summary["model"],
        summary["orient"],
        sum(summary["seconds"].values()),
        f"{summary['points_per_second']:,.0f}",
    )
