"""`jetnormal reconstruct`: a cloud in, a mesh out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from jetnormal.cli.estimate import report_mesh
from jetnormal.cli.options import Device, Json, Quiet, Threads, Verbose, Viewpoint, ViewpointAttribute, set_verbosity
from jetnormal.support.report import print_json


def reconstruct(
    input: Annotated[Path, typer.Argument(metavar="INPUT", help="Point cloud: .ply, .pcd or .xyz.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="MESH", help="File to write: .ply, .obj, .stl, .off or .glb.")
    ],
    depth: Annotated[
        int | None,
        typer.Option(min=4, max=12, metavar="D", help="Depth of the octree.", show_default="the points' spacing"),
    ] = None,
    scale: Annotated[
        float, typer.Option(min=1, max=10, metavar="S", help="Size of the solved cube over that of the cloud.")
    ] = 1.1,
    trim: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="Q",
            help="Share of the vertices to cut off where points are sparse; 0 for none.",
            show_default="none if closed, else where the points end",
        ),
    ] = None,
    recompute: Annotated[bool, typer.Option("--recompute", help="Estimate normals even if INPUT has some.")] = False,
    model: Annotated[
        str, typer.Option(metavar="NAME|FILE", help="What estimates normals, as in jetnormal estimate.")
    ] = "auto",
    orient: Annotated[
        Literal["auto", "global", "mst", "viewpoint", "up"],
        typer.Option(help="How their signs are chosen, as in jetnormal estimate."),
    ] = "auto",
    viewpoint: Viewpoint = None,
    viewpoint_attribute: ViewpointAttribute = None,
    device: Device = "auto",
    threads: Threads = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite MESH where it exists.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make a triangle mesh of a cloud.

    The normals in INPUT are used if it has some; otherwise they are estimated first. The mesh has the colors
    of the cloud and its coordinates, and no degenerate faces, double vertices or specks.

    A surface is taken as open, and cut where the points end, if more than 2 % of its area bridges gaps:
    areas farther from all points than three times the radius around the nearest one that holds eight others.
    A closed surface stays whole, and --trim overrules both.

    On one thread the same INPUT gives the same bytes; on more, the vertices come in another order each time.

    \b
    Examples:
      jetnormal reconstruct scan.ply -o mesh.ply
      jetnormal reconstruct room.pcd -o room.glb --depth 10 --trim 0.1
      jetnormal reconstruct part.xyz -o part.stl --recompute --model jet --json
    """
    set_verbosity(quiet, verbose)
    from jetnormal.jobs.reconstruct import ReconstructOptions, reconstruct_file

    options = ReconstructOptions(
        depth=depth,
        scale=scale,
        trim=trim,
        recompute=recompute,
        model=model,
        orient=orient,
        viewpoint=viewpoint,
        viewpoint_attribute=viewpoint_attribute,
        device=device,
        threads=threads,
        force=force,
    )
    summary = reconstruct_file(input, output, options)
    report_mesh(summary)
    if json:
        print_json(summary)
