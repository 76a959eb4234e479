"""`jetnormal dataset`: clouds with known normals from meshes, procedural solids or scenes, sampled or scanned."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jetnormal.cli.derive import with_options
from jetnormal.cli.options import Json, Quiet, Verbose, set_verbosity
from jetnormal.data.options import DatasetOptions
from jetnormal.errors import UsageError
from jetnormal.support.report import logger, print_json


@with_options
def dataset(
    out: Annotated[Path, typer.Option("--out", "-o", metavar="DIR", help="Folder to create.")],
    meshes: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of meshes (.ply .obj .off .stl .glb .gltf .npz); each is a shape."),
    ] = None,
    synthetic: Annotated[
        int, typer.Option(min=0, metavar="N", help="Number of procedural solids; each is a shape.")
    ] = 0,
    scenes: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of meshes of scenes, or of a folder for each scene, as in SceneNN."),
    ] = None,
    synthetic_scenes: Annotated[
        int, typer.Option(min=0, metavar="N", help="Number of procedural scenes: rooms, streets and terrain in turn.")
    ] = 0,
    scans: Annotated[
        bool, typer.Option("--scans", help="Scan the shapes by virtual scanners instead of sampling them.")
    ] = False,
    *,
    options: DatasetOptions,
    force: Annotated[bool, typer.Option("--force", help="Replace a folder that this command wrote.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Write a benchmark or a training set in PCPNet's layout.

    Each shape gives a cloud for each of PCPNet's six categories: clean points, three levels of Gaussian noise (0.125,
    0.6 and 1.2 % of the bounding box's diagonal), and points whose density has a gradient or stripes. With --scans it
    gives a scan by each of six families of scanners: stripe, depth, lidar, station, fused, photogrammetry. A scene
    gives one cloud of sampled points, or with --scans, if it is procedural, a scan by each scanner that suits it.

    A cloud is NAME.xyz, NAME.normals and NAME.pidx, the points to evaluate or to learn from; stray points of a scan
    are not among them. For a scan, NAME.ply also holds the points, with attributes sensor_x, sensor_y, sensor_z.
    Lists of clouds are testset_*.txt, one for each category, or trainingset_*.txt and validationset_*.txt (no_noise,
    whitenoise, vardensity_whitenoise). The same options give the same bytes.

    \b
    Examples:
      jetnormal dataset --meshes meshes -o benchmark
      jetnormal dataset --synthetic 8 -o benchmark --points 20000
      jetnormal dataset --synthetic 50 --split training --seed 2 -o training
      jetnormal dataset --meshes meshes --synthetic-scenes 6 --scans -o scans
      jetnormal dataset --scenes scenenn -o scenes
      jetnormal evaluate --data benchmark --model cloudfit
      jetnormal evaluate --data scans --model cloudfit --orient viewpoint
      jetnormal estimate scans/cat_lidar.ply -o cat.ply --viewpoint-attribute sensor_x,sensor_y,sensor_z
    """
    set_verbosity(quiet, verbose)
    if scans and scenes:
        raise UsageError("--scans contradicts --scenes: nothing tells where a scanner may stand in these scenes")
    from jetnormal.data.write_benchmark import write_dataset

    clouds = write_dataset(
        out,
        options,
        meshes=meshes,
        solids=synthetic,
        scene_meshes=scenes,
        scenes=synthetic_scenes,
        scans=scans,
        overwrite=force,
    )
    logger.info("%d clouds in %s", len(clouds), out)
    if json:
        print_json({"output": str(out), "clouds": clouds, "points": options.points, "seed": options.seed})
