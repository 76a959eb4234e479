"""`jetnormal preview`: a picture of a cloud or a mesh, or a page in which it turns."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jetnormal.cli.derive import with_options
from jetnormal.cli.options import CLOUDS, Json, Quiet, Verbose, set_verbosity
from jetnormal.jobs.options import PreviewOptions, ReadOptions
from jetnormal.support.report import logger, print_json


@with_options
def preview(
    input: Annotated[
        Path,
        typer.Argument(metavar="FILE", help=f"Cloud ({CLOUDS}) or mesh (.ply .obj .stl .off .glb .gltf .npz)."),
    ],
    options: PreviewOptions,
    files: ReadOptions,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="PICTURE", help="Picture to write: .png.")
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(metavar="PAGE", help="Page to write, in which the object turns: .html, in one file."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite PICTURE and PAGE where they exist.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Draw a cloud or a mesh, without a display or a GPU.

    In a cloud colored by its normals, x is red, y is green and z is blue. The inner side of a surface is
    drawn darker: a sign that is wrong shows.

    \b
    Examples:
      jetnormal preview scan_normals.ply -o scan.png
      jetnormal preview mesh.glb -o mesh.png --views iso,back --size 800 --background dark
      jetnormal preview statue.ply -o statue.png --up 0,1,0 --colors file,normals
      jetnormal preview mesh.ply --html mesh.html
    """
    set_verbosity(quiet, verbose)
    from jetnormal.jobs.preview import preview_file

    summary = preview_file(input, output, html, options, files, overwrite=force)
    for target in (summary["picture"], summary["page"]):
        if target is not None:
            logger.info("wrote %s", target)
    if json:
        print_json(summary)
