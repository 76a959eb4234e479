"""Clouds colored by the errors of their normals, side by side for all models."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jetnormal.evaluation.camera import HEIGHT, WIDTH, Camera, paint
from jetnormal.evaluation.clouds import BenchmarkCloud, read_benchmark_cloud
from jetnormal.evaluation.curves import TITLES, short
from jetnormal.evaluation.protocol import Evaluation
from jetnormal.geometry.neighbors import NeighborIndex

ERROR_LIMIT = 60.0  # degrees, the end of the color scale
COLORS = colormaps["jet"]  # the paper's, as in most work on normals
DOTS_PER_INCH = 150
LAMP = np.array([-0.4, 0.5, 0.77])  # towards it, in the camera's axes
LEFT, RIGHT, TOP, BOTTOM, GAP = 0.35, 0.75, 0.75, 0.1, 0.25  # inches around and below the panels


def draw_heatmaps(evaluation: Evaluation, shape: str, names: Sequence[str]) -> Figure:
    """Draw the clouds of a shape: a column for each, a row for each model, the RMSE below.

    The camera is the same for all. Points that were not evaluated take the color of the nearest one that was.

    Raises:
        InputError: the files of a cloud are no longer there.
    """
    order = list(evaluation.models[0].categories)
    names = sorted(names, key=lambda name: order.index(evaluation.clouds[name]))
    width, height = WIDTH / DOTS_PER_INCH, HEIGHT / DOTS_PER_INCH
    size = np.array([LEFT + width * len(names) + RIGHT, TOP + (height + GAP) * len(evaluation.models) + BOTTOM])
    figure = Figure(figsize=(size[0], size[1]), dpi=DOTS_PER_INCH)
    camera: Camera | None = None
    for column, name in enumerate(names):
        cloud = read_benchmark_cloud(evaluation.data, name, evaluation.all_points)
        camera = camera or Camera(cloud.points, cloud.normals)
        index = camera.render(cloud.points)
        nearest = _nearest_evaluated(cloud)
        for row, model in enumerate(evaluation.models):
            corner = LEFT + width * column, size[1] - TOP - (height + GAP) * row - height
            panel = figure.add_axes((corner[0] / size[0], corner[1] / size[1], width / size[0], height / size[1]))
            errors = model.clouds[name].errors[nearest]
            panel.imshow(paint(index, _lit(COLORS(errors / ERROR_LIMIT)[:, :3], cloud.normals @ camera.axes.T)))
            panel.set(xticks=[], yticks=[])
            panel.spines[:].set_visible(False)
            panel.set_xlabel(f"{model.clouds[name].scores.rmse:.2f}°", fontsize=10, labelpad=2)
            if column == 0:
                panel.set_ylabel(short(model.model), fontsize=10)
            if row == 0:
                category = evaluation.clouds[name]
                panel.set_title(TITLES.get(category, category), fontsize=10)
    _add_color_bar(figure, size)
    title = f"{shape}: error of the normals, and its root mean square"
    figure.text(LEFT / size[0], 1 - 0.12 / size[1], title, fontsize=11, va="top")
    return figure


def _nearest_evaluated(cloud: BenchmarkCloud) -> NDArray[np.int64]:
    """Find for each point (N,) the nearest evaluated point, as its place among those."""
    nearest, _ = NeighborIndex(cloud.points[cloud.queries]).query(cloud.points, 1)
    return nearest[:, 0]


def _lit(colors: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shade colors (N, 3) a little by the normals (N, 3), so that the shape can be seen."""
    normals = normals * np.where(normals[:, 2:] < 0, -1, 1)  # what is seen faces the camera
    light = np.clip(normals @ (LAMP / np.linalg.norm(LAMP)), 0, 1)[:, None]
    return np.clip(colors * (0.65 + 0.35 * light) + 0.3 * light**6, 0, 1)


def _add_color_bar(figure: Figure, size: NDArray[np.float64]) -> None:
    """Add a color bar at the right edge, as high as the panels and at most four inches."""
    height = min(4.0, size[1] - TOP - BOTTOM - GAP)
    middle = BOTTOM + (size[1] - TOP - BOTTOM + GAP) / 2
    place = (size[0] - RIGHT + 0.12, middle - height / 2, 0.13, height)
    panel = figure.add_axes(tuple(place / np.tile(size, 2)))
    bar = figure.colorbar(ScalarMappable(Normalize(0, ERROR_LIMIT), COLORS), cax=panel, ticks=range(0, 61, 10))
    bar.ax.set_yticklabels([f"{tick}°" for tick in range(0, 60, 10)] + ["60°+"], fontsize=9)
    bar.outline.set_visible(False)
