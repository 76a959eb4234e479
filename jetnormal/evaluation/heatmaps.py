"""Clouds colored by the errors of their normals, side by side for all models."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jetnormal.evaluation.clouds import BenchmarkCloud, read_benchmark_cloud
from jetnormal.evaluation.curves import TITLES, short
from jetnormal.evaluation.results import Evaluation, ModelResult
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.rendering.camera import Camera, interesting_direction, make_camera
from jetnormal.rendering.light import develop
from jetnormal.rendering.scene import Scene
from jetnormal.rendering.surfels import Surfels, see

ERROR_LIMIT = 60.0  # degrees, the end of the color scale
COLORS = colormaps["jet"]  # the paper's, as in most work on normals
SIZE = 420  # pixels of the longer side of a panel
SUPERSAMPLING = 2
DOTS_PER_INCH = 150
IN_A_ROW = 4  # models, where there is only one cloud
LEFT, RIGHT, TOP, BOTTOM, GAP = 0.35, 0.75, 0.75, 0.1, 0.25  # inches around and below the panels


def draw_heatmaps(
    evaluation: Evaluation, shape: str, names: Sequence[str], up: tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> Figure:
    """Draw the clouds of a shape: a column for each, a row for each model, the RMSE below.

    The models on a single cloud stand in a grid instead, each under its name. The camera is the same for all. Points
    that were not evaluated take the color of the nearest one that was.

    Args:
        evaluation: what is drawn.
        shape: for the title.
        names: of its clouds.
        up: direction in the clouds' coordinates; y of PCPNet's shapes.

    Raises:
        InputError: the files of a cloud are no longer there.
    """
    order = list(evaluation.models[0].categories)
    names = sorted(names, key=lambda name: order.index(evaluation.clouds[name]))
    clouds = [read_benchmark_cloud(evaluation.data, name, evaluation.all_points) for name in names]
    middle = (clouds[0].points.min(axis=0) + clouds[0].points.max(axis=0)) / 2
    scenes = [_scene(cloud, middle).turned_up(np.array(up)) for cloud in clouds]
    towards = interesting_direction(scenes[0].points, scenes[0].normals)
    camera = make_camera(scenes[0].points, towards, SIZE * SUPERSAMPLING)
    width, height = (side / SUPERSAMPLING / DOTS_PER_INCH for side in (camera.width, camera.height))
    across = min(IN_A_ROW, len(evaluation.models)) if len(names) == 1 else len(names)
    gap = 2 * GAP if len(names) == 1 else GAP  # every row has titles
    rows = -(-len(names) * len(evaluation.models) // across)
    size = np.array([LEFT + width * across + RIGHT, TOP + (height + gap) * rows + BOTTOM])
    figure = Figure(figsize=(size[0], size[1]), dpi=DOTS_PER_INCH)
    surfels = [_facing(see(scene, camera), camera) for scene in scenes]
    nearest = [_nearest_evaluated(cloud) for cloud in clouds]
    for row, column, number, model, title, label in _panels(evaluation, names, across):
        result = model.clouds[names[number]]
        painted = _painted(surfels[number], result.errors[nearest[number]])
        corner = LEFT + width * column, size[1] - TOP - (height + gap) * row - height
        panel = figure.add_axes((corner[0] / size[0], corner[1] / size[1], width / size[0], height / size[1]))
        panel.imshow(develop(painted, camera, scenes[0].radius, SUPERSAMPLING, "white"))
        panel.set(xticks=[], yticks=[])
        panel.spines[:].set_visible(False)
        panel.set_xlabel(f"{result.scores.rmse:.2f}°", fontsize=10, labelpad=2)
        panel.set_ylabel(label, fontsize=10)
        panel.set_title(title, fontsize=10)
    _add_color_bar(figure, size)
    title = f"{shape}: errors of normals, RMSE below"
    figure.text(0.12 / size[0], 1 - 0.12 / size[1], title, fontsize=11, va="top", wrap=True)
    return figure


def _panels(
    evaluation: Evaluation, names: Sequence[str], across: int
) -> Iterator[tuple[int, int, int, ModelResult, str, str]]:
    """Yield row, column, number of the cloud, model, title and label of each panel."""
    for number, name in enumerate(names):
        category = evaluation.clouds[name]
        for place, model in enumerate(evaluation.models):
            if len(names) == 1:
                yield *divmod(place, across), number, model, short(model.model), ""
            else:
                title = "" if place else TITLES.get(category, category)
                yield place, number, number, model, title, "" if number else short(model.model)


def _painted(surfels: Surfels, errors: NDArray[np.floating]) -> Surfels:
    """The same in the colors of the errors (N,) of their points."""
    colors = COLORS(errors / ERROR_LIMIT)[:, :3]
    return replace(surfels, colors=colors[surfels.index].astype(np.float32))


def _scene(cloud: BenchmarkCloud, middle: NDArray[np.float64]) -> Scene:
    return Scene(cloud.points - middle, cloud.normals, np.ones_like(cloud.points))


def _facing(surfels: Surfels, camera: Camera) -> Surfels:
    """The same with normals towards the camera: which side of a surface is seen does not matter here."""
    away = (surfels.normals * camera.rays()).sum(axis=2, keepdims=True) > 0
    normals = np.where(away, -surfels.normals, surfels.normals)
    return replace(surfels, normals=normals, back=np.zeros_like(surfels.back))


def _nearest_evaluated(cloud: BenchmarkCloud) -> NDArray[np.int64]:
    """Find for each point (N,) the nearest evaluated point, as its place among those."""
    nearest, _ = NeighborIndex(cloud.points[cloud.queries]).query(cloud.points, 1)
    return nearest[:, 0]


def _add_color_bar(figure: Figure, size: NDArray[np.float64]) -> None:
    """Add a color bar at the right edge, as high as the panels and at most four inches."""
    height = min(4.0, size[1] - TOP - BOTTOM - GAP)
    middle = BOTTOM + (size[1] - TOP - BOTTOM + GAP) / 2
    place = (size[0] - RIGHT + 0.12, middle - height / 2, 0.13, height)
    panel = figure.add_axes(tuple(place / np.tile(size, 2)))
    bar = figure.colorbar(ScalarMappable(Normalize(0, ERROR_LIMIT), COLORS), cax=panel, ticks=range(0, 61, 10))
    bar.ax.set_yticklabels([f"{tick}°" for tick in range(0, 60, 10)] + ["60°+"], fontsize=9)
    bar.outline.set_visible(False)
