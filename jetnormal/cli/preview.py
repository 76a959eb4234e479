"""`jetnormal preview`: a picture of a cloud or a mesh, or a page in which it turns."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from jetnormal.cli.options import Json, Quiet, Verbose, parse_vector, set_verbosity
from jetnormal.support.report import logger, print_json


def preview(
    input: Annotated[
        Path, typer.Argument(metavar="FILE", help="Cloud (.ply .pcd .xyz) or mesh (.ply .obj .stl .off .glb .npz).")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="PICTURE", help="Picture to write: .png.")
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(metavar="PAGE", help="Page to write, in which the object turns: .html, in one file."),
    ] = None,
    views: Annotated[
        str,
        typer.Option(
            metavar="V,V,...",
            help="Side by side: iso, front, back, left, right, top, bottom, or AZIMUTH:ELEVATION in degrees.",
            show_default="auto: the side that was scanned, else iso",
        ),
    ] = "auto",
    up: Annotated[
        Any, typer.Option(parser=parse_vector, metavar="X,Y,Z", help="Direction that is up in the views.")
    ] = "0,0,1",
    size: Annotated[
        int, typer.Option(min=16, max=8192, metavar="N", help="Pixels of the longer side of a view.")
    ] = 1000,
    colors: Annotated[
        str,
        typer.Option(
            metavar="C,C,...",
            help="Side by side: normals, file (its own), plain, or auto: a cloud by its normals, a mesh by its own.",
        ),
    ] = "auto",
    background: Annotated[Literal["white", "dark"], typer.Option(help="Of the picture and the page.")] = "white",
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
    from jetnormal.jobs.preview import PreviewOptions, preview_file

    options = PreviewOptions(
        views=tuple(view.strip() for view in views.split(",")),
        up=up,
        size=size,
        colors=tuple(coloring.strip() for coloring in colors.split(",")),
        background=background,
        force=force,
    )
    summary = preview_file(input, output, html, options)
    for target in (summary["picture"], summary["page"]):
        if target is not None:
            logger.info("wrote %s", target)
    if json:
        print_json(summary)
