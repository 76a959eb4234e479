"""The paper's figures of an evaluation, as PNG, PDF or SVG files (Du et al., CVPR 2023, figs. 1, 3, 5 and 6).

good_points          share of points below each error, a panel for each category
z_angles             error over the angle between normal and z axis, and that angle before and after the transform
heatmap_SHAPE        the clouds of a shape, colored by their errors: a row for each model, a column for each category
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from jetnormal.errors import InputError, ResourceError
from jetnormal.formats.atomic import atomic_write, make_folder
from jetnormal.formats.pcpnet import shape_of
from jetnormal.support.extras import advice
from jetnormal.support.report import progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from jetnormal.evaluation.results import Evaluation


def check_plots(folder: Path, overwrite: bool, suffix: str = "png") -> None:
    """Find out, before any long computation, whether pictures can be drawn.

    Raises:
        ResourceError: Matplotlib is not installed.
        InputError: there are pictures in the folder already that may not be overwritten, or it is none.
    """
    if find_spec("matplotlib") is None:
        raise ResourceError(f"`plots` needs Matplotlib, but {advice('matplotlib')}")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is no folder; choose another one for the pictures")
    if not overwrite and any(folder.glob(f"*.{suffix}")):
        raise InputError(f"{folder}: holds pictures already; use `overwrite` to replace them or choose another folder")


def write_plots(
    evaluation: Evaluation, folder: Path, suffix: str = "png", up: tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> list[Path]:
    """Draw all figures for which the evaluation has data. The folder is created; pictures are overwritten.

    Args:
        evaluation: what is drawn.
        folder: for the pictures.
        suffix: "png", "pdf" or "svg". The same evaluation gives the same bytes.
        up: direction in the clouds' coordinates that is up in heatmaps.

    Raises:
        InputError: a picture cannot be written, or the files of a cloud are no longer there.
    """
    from matplotlib import rc_context

    from jetnormal.evaluation.curves import draw_good_points, draw_z_angles
    from jetnormal.evaluation.heatmaps import draw_heatmaps

    make_folder(folder)
    shapes: dict[str, list[str]] = {}
    for name, category in evaluation.clouds.items():
        shapes.setdefault(shape_of(name, category), []).append(name)
    with rc_context({"text.parse_math": False, "svg.hashsalt": "jetnormal"}):  # a dollar sign in a name is one
        paths = [_save(draw_good_points(evaluation), folder / f"good_points.{suffix}")]
        if figure := draw_z_angles(evaluation):
            paths.append(_save(figure, folder / f"z_angles.{suffix}"))
        with progress("drawing", len(evaluation.clouds), "clouds") as advance:
            for shape, names in shapes.items():
                figure = draw_heatmaps(evaluation, shape, names, up)
                paths.append(_save(figure, folder / f"heatmap_{shape}.{suffix}"))
                advance(len(names))
    return paths


def _save(figure: Figure, path: Path) -> Path:
    suffix = path.suffix[1:]
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}
    with atomic_write(path, overwrite=True) as stream:
        figure.savefig(stream, format=suffix, metadata=undated.get(suffix))
    return path
