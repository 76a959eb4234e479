"""Curves of an evaluation: the share of good points, and the angle to the z axis before and after the transform."""

from __future__ import annotations

from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from jetnormal.evaluation.results import Evaluation, ModelResult
from jetnormal.evaluation.scores import AUC_LIMIT, THRESHOLDS

TITLES = {
    "none": "no noise",
    "low": "low noise",
    "medium": "medium noise",
    "high": "high noise",
    "gradient": "density gradient",
    "striped": "density stripes",
}
# Okabe and Ito's colors, which all readers can tell apart; the lightest is left out.
COLORS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000"]
LONGEST_NAME = 30  # characters
LARGE_ANGLE = 20.0  # degrees, beyond which the paper counts a z angle as large
Z_LIMIT = 60.0  # degrees, where the figure of z angles ends
Z_BIN = 5.0  # degrees, for the error over the z angle
Z_STEP = 2.0  # degrees, for its distribution
Z_LEAST = 30  # points that a bin must hold to be drawn


def draw_good_points(evaluation: Evaluation) -> Figure:
    """Draw the share of points with an error below a threshold, over the threshold; a panel for each category."""
    categories = list(evaluation.models[0].categories)
    columns = min(3, len(categories))
    rows = -(-len(categories) // columns)
    figure = Figure(figsize=(4.2 * columns, 3.5 * rows), dpi=150, layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for panel, category in zip(panels, categories, strict=False):
        for model, color in zip(evaluation.models, cycle(COLORS), strict=False):
            label = f"{short(model.model)}  ({100 * model.categories[category].auc:.1f} %)"
            panel.plot(THRESHOLDS, model.curves[category], color=color, linewidth=1.8, label=label)
        panel.set_title(TITLES.get(category, category))
        panel.legend(loc="best", fontsize=8, frameon=False, title="area under the curve", title_fontsize=8)
        _plain(panel)
    for panel in panels[len(categories) :]:
        panel.set_visible(False)
    panels[0].set(xlim=(0, AUC_LIMIT), ylim=(0, 1))
    panels[0].yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    figure.supxlabel("threshold of the error (degrees)", fontsize=10)
    figure.supylabel("points with a smaller error", fontsize=10)
    return figure


def draw_z_angles(evaluation: Evaluation) -> Figure | None:
    """Draw the error over the z angle, and the distribution of the z angle; None without a learned transform."""
    networks = [model for model in evaluation.models if any(one.z_angles for one in model.clouds.values())]
    if not networks:
        return None
    figure = Figure(figsize=(10, 4), dpi=150, layout="constrained")
    errors_panel, density_panel = figure.subplots(1, 2)
    for network, color in zip(networks, cycle(COLORS), strict=False):
        before, after, errors = _z_angles(network)
        _draw_errors(errors_panel, after, errors, short(network.model), color)
        _draw_density(density_panel, before, f"{short(network.model)}: plane of the patch", color, "--")
        _draw_density(density_panel, after, f"{short(network.model)}: learned transform", color, "-")
    errors_panel.set(
        xlim=(0, Z_LIMIT),
        ylim=(0, None),
        xlabel="angle of true normal and z axis after the transform (degrees)",
        ylabel="error: mean and quartiles (degrees)",
        title="error over the z angle",
    )
    density_panel.set(
        xlim=(0, Z_LIMIT),
        ylim=(0, None),
        xlabel="angle of true normal and z axis (degrees)",
        ylabel="points per degree",
        title="distribution of the z angle",
    )
    density_panel.axvline(LARGE_ANGLE, color="0.6", linewidth=0.8, linestyle=":")
    density_panel.yaxis.set_major_formatter(PercentFormatter(1.0, symbol=" %"))
    for panel in (errors_panel, density_panel):
        panel.legend(fontsize=8, frameon=False)
        _plain(panel)
    return figure


def short(name: str) -> str:
    """Shorten the name of a model: of a long path, keep the end."""
    return name if len(name) <= LONGEST_NAME else "…" + name[1 - LONGEST_NAME :]


def _z_angles(model: ModelResult) -> NDArray[np.float32]:
    """Collect the z angles before and after the transform, and the errors, of all measured points: (3, S)."""
    found = [
        (one.z_angles.before, one.z_angles.after, one.errors[one.z_angles.rows])
        for one in model.clouds.values()
        if one.z_angles
    ]
    return np.concatenate(found, axis=1)


def _draw_errors(panel: Any, angles: NDArray[np.float32], errors: NDArray[np.float32], label: str, color: str) -> None:
    """Draw mean and quartiles of the error in each bin of the angle that holds enough points."""
    bins = (angles // Z_BIN).astype(int)
    used = [bin for bin in range(int(Z_LIMIT // Z_BIN)) if (bins == bin).sum() >= Z_LEAST]
    centers = Z_BIN * (np.array(used) + 0.5)
    inside = [errors[bins == bin] for bin in used]
    quartiles = np.array([np.percentile(one, [25, 75]) for one in inside]).reshape(-1, 2)
    panel.fill_between(centers, *quartiles.T, color=color, alpha=0.15, linewidth=0)
    panel.plot(centers, [one.mean() for one in inside], color=color, marker="o", markersize=4, label=label)


def _draw_density(panel: Any, angles: NDArray[np.float32], label: str, color: str, style: str) -> None:
    """Draw the share of points by angle; the legend tells the share of large angles."""
    counts, edges = np.histogram(angles, bins=np.arange(0, Z_LIMIT + Z_STEP, Z_STEP))
    label += f"  ({100 * np.mean(angles >= LARGE_ANGLE):.0f} % beyond {LARGE_ANGLE:.0f}°)"
    panel.stairs(counts / len(angles) / Z_STEP, edges, color=color, linestyle=style, linewidth=1.5, label=label)


def _plain(panel: Any) -> None:
    """Give the axes a light grid and no box."""
    panel.grid(color="0.9", linewidth=0.8)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
