"""`jetnormal estimate`: one cloud in, the same cloud with normals out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from jetnormal.cli.derive import with_options
from jetnormal.cli.failures import spell
from jetnormal.cli.options import CLOUDS, Json, Quiet, Verbose, set_verbosity
from jetnormal.errors import UsageError
from jetnormal.jobs.options import BatchOptions, EstimateOptions, FileOptions, LargeOptions, ReconstructOptions
from jetnormal.support.report import logger, print_json
from jetnormal.support.streams import STREAM


@with_options
def estimate(
    input: Annotated[
        list[Path],
        typer.Argument(metavar="INPUT", help=f"Point clouds: {CLOUDS}, or - (a stream)."),
    ],
    options: EstimateOptions,
    files: FileOptions,
    batch: BatchOptions,
    large: LargeOptions,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="OUTPUT", help="File to write, in any of these formats, or -."),
    ] = None,
    out_dir: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the results of many files, under their names; --format is that of the results.",
            rich_help_panel="Many files",
        ),
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

    With --out-dir, a file that fails does not stop the others; the exit code is that of the first failure.

    \b
    Examples:
      jetnormal estimate scan.ply -o scan_normals.ply
      jetnormal estimate scan.e57 -o scan.laz --model jet --k 32 --order 2
      jetnormal estimate room.ply -o room_normals.ply --viewpoint 0,0,1.6
      jetnormal estimate terrain.laz -o terrain_normals.laz --orient up
      jetnormal estimate part.csv -o part.ply --columns id,x,y,z --curvature --json
      jetnormal estimate statue.ply -o statue_normals.ply --mesh statue.glb
      jetnormal estimate scans/*.laz --out-dir normals --skip-existing
      jetnormal estimate city.laz -o city_normals.laz --max-memory 8GB
      cat scan.xyz | jetnormal estimate - -o - --format xyz | ...
    """
    set_verbosity(quiet, verbose)
    _check_outputs(input, output, out_dir, mesh, batch, json)
    if out_dir is not None and large != LargeOptions():
        raise UsageError("`max_memory`, `resume` and `cluster` go with `output`")
    if out_dir is not None:
        _estimate_many(input, out_dir, options, files, batch, force, json)
        return
    assert output is not None
    if mesh is not None:
        check_mesh(mesh, output, options.orient, force)
    from jetnormal.jobs.estimate import estimate_file

    summary = estimate_file(input[0], output, options, files, large, overwrite=force)
    report(summary)
    if mesh is not None:
        from jetnormal.jobs.reconstruct import reconstruct_file

        surface = ReconstructOptions(threads=options.threads)
        summary["mesh"] = reconstruct_file(output, mesh, surface, overwrite=force)
        report_mesh(summary["mesh"])
    if json:
        print_json(summary)


def _check_outputs(
    inputs: list[Path], output: Path | None, folder: Path | None, mesh: Path | None, batch: BatchOptions, json: bool
) -> None:
    """Check that the options name one place for every result.

    Raises:
        UsageError: they do not.
    """
    if (output is None) == (folder is None):
        raise UsageError("give `output` for one file, or `out_dir` for many")
    if folder is not None and mesh is not None:
        raise UsageError("`mesh` goes with `output`: reconstruct the files in `out_dir` one by one")
    if folder is None and len(inputs) > 1:
        raise UsageError(f"{len(inputs)} inputs need `out_dir`, a folder for the results")
    if folder is None and batch != BatchOptions():
        raise UsageError("`suffix`, `jobs` and `skip_existing` go with `out_dir`")
    if STREAM in map(str, inputs) and folder is not None:
        raise UsageError("a stream has no name for a file in `out_dir`: give `output`")
    if str(output) == STREAM and json:
        raise UsageError("the cloud and `json` cannot both go to standard output")
    if str(output) == STREAM and mesh is not None:
        raise UsageError("a mesh is made of a file: give `output` a name")


def _estimate_many(
    inputs: list[Path],
    folder: Path,
    options: EstimateOptions,
    files: FileOptions,
    batch: BatchOptions,
    force: bool,
    json: bool,
) -> None:
    from jetnormal.jobs.batch import estimate_files

    summary = estimate_files(inputs, folder, options, files, batch, overwrite=force, finished=_report_one)
    counts = (len(summary["files"]), len(summary["skipped"]), len(summary["failed"]))
    logger.info("%s: %d files done, %d skipped, %d failed", folder, *counts)
    if json:
        print_json(summary)
    if summary["failed"]:
        raise typer.Exit(summary["failed"][0]["code"])


def _report_one(result: dict[str, Any]) -> None:
    """Log the result of one of many files; every message names the file."""
    source = result["input"]

    def naming(message: str) -> str:
        named = source in message or result.get("output", source) in message
        return spell(message if named else f"{source}: {message}")

    if "error" in result:
        result["error"] = naming(result["error"])
        logger.error("%s", result["error"])
    else:
        result["warnings"] = [naming(warning) for warning in result["warnings"]]
        report(result)


def check_mesh(mesh: Path, output: Path, orient: str, force: bool) -> None:
    """Check before the long work that a mesh can be made and written.

    Raises:
        UsageError: it would overwrite the cloud, or has no outside.
        InputError: it cannot be written.
    """
    from jetnormal.formats.meshes import check_mesh_target
    from jetnormal.support.open3d_loader import require_open3d

    if os.path.realpath(mesh) == os.path.realpath(output):  # Path.resolve fails on a loop of links
        raise UsageError(f"{mesh}: the mesh would overwrite the cloud; give it a name of its own")
    if orient == "none":
        raise UsageError("a mesh needs to know outside from inside: leave `orient=none` out")
    check_mesh_target(mesh, overwrite=force)
    require_open3d("reconstructs surfaces")


def report_warnings(summary: dict[str, Any]) -> None:
    """Log warnings, with options spelled as flags."""
    summary["warnings"] = [spell(warning) for warning in summary["warnings"]]
    for warning in summary["warnings"]:
        logger.warning("%s", warning)


def report_mesh(summary: dict[str, Any]) -> None:
    """Log the mesh that was made, and warnings about it."""
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
    """Log what was done, and warnings about it."""
    report_warnings(summary)
    logger.info(
        "wrote %s: %s of %s points have normals (model %s, signs %s: %s; %.1f s, %s points/s)",
        summary["output"],
        f"{summary['valid']:,}",
        f"{summary['points']:,}",
        summary["model"],
        summary["orient"]["used"],
        summary["orient"]["reason"],
        sum(summary["seconds"].values()),
        f"{summary['points_per_second']:,.0f}",
    )
