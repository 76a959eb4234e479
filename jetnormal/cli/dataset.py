"""`jetnormal dataset`: clouds with known normals from meshes or procedural solids."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from jetnormal.cli.options import Json, Quiet, Verbose, set_verbosity
from jetnormal.support.report import logger, print_json


def dataset(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to create.")],
    meshes: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of meshes (.ply .obj .off .stl .glb .gltf .npz), a shape each."),
    ] = None,
    synthetic: Annotated[int, typer.Option(min=0, metavar="N", help="Number of procedural solids, a shape each.")] = 0,
    points: Annotated[int, typer.Option(min=3, metavar="N", help="Points of each cloud.")] = 100_000,
    queries: Annotated[
        int, typer.Option(min=1, metavar="N", help="Points of each cloud in its .pidx, at most.")
    ] = 5_000,
    split: Annotated[
        Literal["test", "training", "validation"], typer.Option(help="What the set is for: decides on its lists.")
    ] = "test",
    seed: Annotated[int, typer.Option(min=0, metavar="S", help="Of all that is random.")] = 1,
    force: Annotated[bool, typer.Option("--force", help="Replace a folder that this command wrote.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a benchmark or a training set in PCPNet's layout.

    Of each shape come PCPNet's six categories: clean points, three levels of Gaussian noise (0.125, 0.6 and 1.2 %
    of the bounding box's diagonal), and points whose density has a gradient or stripes. A cloud is NAME.xyz,
    NAME.normals and NAME.pidx, the points to evaluate or to learn from; lists of clouds are testset_*.txt, or
    trainingset_*.txt and validationset_*.txt (no_noise, whitenoise, vardensity_whitenoise). The same options give
    the same bytes.

    \b
    Examples:
      jetnormal dataset --meshes meshes -o benchmark
      jetnormal dataset --synthetic 8 -o benchmark --points 20000
      jetnormal dataset --synthetic 50 --split training --seed 2 -o training
      jetnormal evaluate --data benchmark --model cloudfit
    """
    set_verbosity(quiet, verbose)
    from jetnormal.data.write_benchmark import DatasetOptions, write_dataset

    options = DatasetOptions(points, queries, split, seed)
    clouds = write_dataset(out, options, meshes=meshes, solids=synthetic, overwrite=force)
    logger.info("%d clouds in %s", len(clouds), out)
    if json:
        print_json({"output": str(out), "clouds": clouds, "points": points, "seed": seed})
