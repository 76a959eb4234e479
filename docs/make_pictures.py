"""Make the pictures of the documentation again: run the tutorial's commands, and draw CloudFit.

    python docs/make_pictures.py

The tutorial's commands run as they stand in tutorial.md, in the root of the repository.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "pictures"
MAX_WIDTH = 1340
MADE = {  # by the tutorial: picture of the documentation
    "milk.png": "milk.png",
    "part.png": "part.png",
    "part_mesh.png": "part_mesh.png",
    "plots/heatmap_solid_001.png": "heatmap.png",
}


def tutorial() -> None:
    """Run the tutorial and keep its pictures."""
    shutil.rmtree(ROOT / "demo", ignore_errors=True)
    text = (ROOT / "docs" / "tutorial.md").read_text()
    for block in re.findall(r"```sh\n(.*?)```", text, re.S):
        subprocess.run(["bash", "-ec", block], cwd=ROOT, check=True)
    for made, picture in MADE.items():
        image = Image.open(ROOT / "demo" / made).convert("RGB")
        image.thumbnail((MAX_WIDTH, MAX_WIDTH))
        image.quantize(256, dither=Image.Dither.NONE).save(PICTURES / picture, optimize=True)


def cloudfit() -> None:
    """Draw the pyramid of CloudFit: features are gathered on the way up, normals are voted for on the way down."""
    levels = [("even level", 64), ("1/4", 128), ("1/16", 192), ("1/64", 192), ("1/256", 192), ("1/1024", 192)]
    figure, axes = pyplot.subplots(figsize=(9.6, 4.9), dpi=110)
    axes.set(xlim=(-2.5, 12.6), ylim=(-0.4, 6.2))
    axes.axis("off")
    gray, blue, green, red = "#d8dde3", "#c7dcf2", "#cdeacb", "#f6d3c6"

    def box(x: float, y: float, width: float, text: str, color: str) -> None:
        shape = FancyBboxPatch((x, y), width, 0.62, boxstyle="round,pad=0.05", facecolor=color, edgecolor="#555")
        axes.add_patch(shape)
        axes.text(x + width / 2, y + 0.31, text, ha="center", va="center", fontsize=8.5)

    def arrow(start: tuple[float, float], end: tuple[float, float], style: str = "-") -> None:
        options = {"arrowstyle": "-|>", "mutation_scale": 11, "color": "#444", "linestyle": style}
        axes.add_patch(FancyArrowPatch(start, end, **options))

    box(-2.3, 0, 1.5, "cloud", red)
    arrow((-0.72, 0.31), (-0.08, 0.31))
    last = len(levels) - 1
    for number, (share, channels) in enumerate(levels):
        y, shift = number * 1.05, number * 0.45
        box(shift, y, 1.5, f"{share}\n{channels} channels", gray)
        box(6.5 - shift, y, 1.9, "normals:\nneighbors vote", blue)
        arrow((shift + 1.6, y + 0.31), (6.4 - shift, y + 0.31), "--" if number < last else "-")
        if number < last:
            arrow((shift + 0.9, y + 0.70), (shift + 1.2, y + 1.0))
            arrow((7.05 - shift, y + 1.0), (7.35 - shift, y + 0.72))
    box(9.1, 0, 1.3, "all points:\na last vote", blue)
    box(11.0, 0, 1.5, "normals,\nconfidence", red)
    box(11.0, 1.05, 1.5, "curvatures:\nWeingarten", green)
    arrow((8.5, 0.31), (9.02, 0.31))
    arrow((10.48, 0.31), (10.92, 0.31))
    arrow((11.75, 0.70), (11.75, 1.0))
    axes.text(-0.1, -0.32, "up: thin, average, gather features", fontsize=8, color="#444")
    axes.text(5.0, -0.32, "down: coarse normals guide finer ones", fontsize=8, color="#444")
    figure.savefig(PICTURES / "cloudfit.png", bbox_inches="tight")
    pyplot.close(figure)


if __name__ == "__main__":
    PICTURES.mkdir(exist_ok=True)
    cloudfit()
    tutorial()
