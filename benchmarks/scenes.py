"""Models on scenes: sampled from procedural rooms, streets and terrain, and from meshes reconstructed of their scans.

    python benchmarks/scenes.py -o scenes [--model cloudfit ...] [--plots scenes_plots] > benchmarks/results/scenes.md

The second kind repeats the experiment that Du et al. (CVPR 2023) made with SceneNN, on other scenes: points are
sampled from a reconstructed mesh, and its normals are the true ones. The scenes are scanned by virtual terrestrial
stations, terrain from the air. The meshes are `jetnormal reconstruct`'s of the normals of pca:k=30, which is not
among the models, turned towards the scanners. Everything is made in the folder by the commands of jetnormal, with
fixed seeds. It is kept there, the estimated normals too: a second run computes only what is new.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jetnormal
from jetnormal.evaluation.tables import make_tables, markdown

CLASSICAL = ["pca:small", "pca:medium", "pca:large", "jet:small", "jet:medium", "jet:large"]
MODELS = [*CLASSICAL, "cloudfit", "iternet", "deepfit-small", "adafit-small", "graphfit-small"]
SEED = 18
SCENES = 6
SCANNERS = {"room": "station", "street": "station", "terrain": "airborne"}
SENSORS = "sensor_x,sensor_y,sensor_z"


def run(*words: object) -> None:
    """Run a command of jetnormal; what it says goes to standard error."""
    subprocess.run([sys.executable, "-m", "jetnormal", *map(str, words)], check=True, stdout=sys.stderr)


def make_data(folder: Path, queries: int) -> dict[str, Path]:
    """The two benchmarks in the folder, by their titles."""
    draw = ("--synthetic-scenes", SCENES, "--seed", SEED, "--queries", queries)
    scans, meshes, sampled, rebuilt = (folder / name for name in ("scans", "meshes", "sampled", "rebuilt"))
    if not sampled.exists():
        run("dataset", *draw, "-o", sampled)
    if not scans.exists():
        run("dataset", *draw, "--scans", "--points", 200_000, "-o", scans)
    meshes.mkdir(exist_ok=True)
    for scan in sorted(scans.glob("*.ply")):
        kind, _, scanner = scan.stem.split("_")
        mesh = meshes / f"{scan.stem}.ply"
        if scanner == SCANNERS[kind] and not mesh.exists():
            run("reconstruct", scan, "--model", "pca:k=30", "--viewpoint-attribute", SENSORS, "-o", mesh)
    if not rebuilt.exists():
        run("dataset", "--scenes", meshes, "--seed", SEED, "--queries", queries, "-o", rebuilt)
    return {"sampled": sampled, "rebuilt": rebuilt}


def main() -> None:
    """Make the data, evaluate the models, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for data and results")
    parser.add_argument("--model", action="append", help=f"default: {' '.join(MODELS)}")
    parser.add_argument("--queries", type=int, default=2000, help="points of each cloud that are evaluated")
    parser.add_argument("--plots", type=Path, help="folder for heatmaps of the errors")
    options = parser.parse_args()
    models = options.model or MODELS
    options.out.mkdir(parents=True, exist_ok=True)
    for name, data in make_data(options.out, options.queries).items():
        found = jetnormal.evaluate(data, models, results=options.out / f"kept_{name}")
        rmse, _, pgp10, _ = make_tables(found)
        titled = [replace(table, title=f"{table.title}, {name} scenes") for table in (rmse, pgp10)]
        print(markdown(titled), flush=True)
        if options.plots:
            from jetnormal.evaluation.plots import write_plots

            write_plots(found, options.plots / name, up=(0, 0, 1))


if __name__ == "__main__":
    main()
