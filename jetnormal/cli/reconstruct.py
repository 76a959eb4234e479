"""`jetnormal reconstruct`: one cloud in, a triangle mesh out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jetnormal.cli.derive import with_options
from jetnormal.cli.estimate import report_mesh
from jetnormal.cli.options import CLOUDS, Json, Quiet, Verbose, set_verbosity
from jetnormal.jobs.options import ReadOptions, ReconstructOptions
from jetnormal.support.report import print_json


@with_options
def reconstruct(
    input: Annotated[Path, typer.Argument(metavar="INPUT", help=f"Point cloud: {CLOUDS}, or - (a stream).")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="MESH", help="File to write: .ply, .obj, .stl, .off or .glb.")
    ],
    options: ReconstructOptions,
    files: ReadOptions,
    force: Annotated[bool, typer.Option("--force", help="Overwrite MESH where it exists.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Make a triangle mesh of a cloud.

    The normals in INPUT are used if it has some; otherwise they are estimated first. The mesh has the colors
    of the cloud and its coordinates, and no degenerate faces, double vertices or specks.

    A surface counts as open if more than 2 % of its area bridges gaps: it is farther from all points than three times
    the radius around the nearest one that holds eight others. An open surface is cut where the points end, a closed one
    stays whole; --trim overrules both.

    On one thread the same INPUT gives the same bytes; on more, the vertices come in another order each time.

    \b
    Examples:
      jetnormal reconstruct scan.ply -o mesh.ply
      jetnormal reconstruct room.pcd -o room.glb --depth 10 --trim 0.1
      jetnormal reconstruct part.xyz -o part.stl --recompute --model jet --json
    """
    set_verbosity(quiet, verbose)
    from jetnormal.jobs.reconstruct import reconstruct_file

    summary = reconstruct_file(input, output, options, files, overwrite=force)
    report_mesh(summary)
    if json:
        print_json(summary)
