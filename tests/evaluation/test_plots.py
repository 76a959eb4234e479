from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from matplotlib.image import imread

from jetnormal import evaluate
from jetnormal.errors import InputError, ResourceError
from jetnormal.evaluation import plots
from jetnormal.evaluation.curves import draw_good_points, draw_z_angles
from jetnormal.evaluation.heatmaps import draw_heatmaps
from jetnormal.evaluation.plots import check_plots, write_plots
from jetnormal.evaluation.scores import THRESHOLDS


@pytest.fixture
def clouds(tmp_path, write_sphere):
    """A sphere and a noisy one of twice the radius, for which `turned` is off by twice the angle."""
    write_sphere(tmp_path, "ball", 1, queries=range(200))
    write_sphere(tmp_path, "ball_noise_white_1.20e-02", 2)
    return tmp_path


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_pictures_have_names_that_tell_what_they_show(clouds, tmp_path, write_sphere, turned):
    write_sphere(clouds, "$box$")
    paths = write_plots(evaluate(clouds, [turned(1.0, "$\\odd$")], z_angles=True), tmp_path / "new" / "plots")
    assert names(tmp_path / "new" / "plots") == ["good_points.png", "heatmap_$box$.png", "heatmap_ball.png"]
    assert sorted(path.name for path in paths) == names(tmp_path / "new" / "plots")
    for path in paths:
        assert imread(path).std() > 0.01


@pytest.mark.parametrize(("suffix", "start"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_figures_for_print_are_the_same_bytes_each_time(clouds, tmp_path, turned, suffix, start):
    evaluation = evaluate(clouds, [turned(3.0)])
    contents = []
    for folder in ("one", "two"):
        paths = write_plots(evaluation, tmp_path / folder, suffix, up=(0, 0, 1))
        assert [path.name for path in paths] == [f"good_points.{suffix}", f"heatmap_ball.{suffix}"]
        contents.append([path.read_bytes() for path in paths])
    assert contents[0] == contents[1] and all(content.startswith(start) for content in contents[0])


def test_curves_are_those_of_the_evaluation(clouds, turned):
    evaluation = evaluate(clouds, [turned(8.0, "good"), turned(14.0, "bad")])
    figure = draw_good_points(evaluation)
    first, second = (panel for panel in figure.axes if panel.get_visible())
    assert [first.get_title(), second.get_title()] == ["no noise", "high noise"]
    good, _ = second.get_lines()
    np.testing.assert_array_equal(good.get_xdata(), THRESHOLDS)
    np.testing.assert_array_equal(good.get_ydata(), evaluation.models[0].curves["high"])
    labels = [text.get_text() for text in second.get_legend().get_texts()]
    assert labels == ["good  (46.7 %)", "bad  (6.7 %)"]


def test_heatmaps_have_a_row_per_model_with_its_errors_as_colors(clouds, turned):
    evaluation = evaluate(clouds, [turned(0.0, "right"), turned(30.0, "wrong")])
    figure = draw_heatmaps(evaluation, "ball", list(reversed(evaluation.clouds)))
    panels = [panel for panel in figure.axes if panel.images]
    assert figure.texts[0].get_text() == "ball: errors of normals, RMSE below"
    assert [panel.get_title() for panel in panels] == ["no noise", "", "high noise", ""]
    assert [panel.get_ylabel() for panel in panels] == ["right", "wrong", "", ""]
    assert [panel.get_xlabel() for panel in panels] == ["0.00°", "30.00°", "0.00°", "60.00°"]
    colors = []
    for panel in panels:
        image = np.asarray(panel.images[0].get_array()) / 255
        colors.append(np.median(image[image.min(axis=2) < 0.9], axis=0).argmax())
    assert colors == [2, 1, 2, 0]  # blue, green, blue, red


def test_models_on_a_single_cloud_stand_in_a_grid(clouds, turned):
    evaluation = evaluate(clouds, [turned(float(angle), f"by {angle}") for angle in range(5)])
    figure = draw_heatmaps(evaluation, "ball", ["ball"])
    panels = [panel for panel in figure.axes if panel.images]
    assert [panel.get_title() for panel in panels] == ["by 0", "by 1", "by 2", "by 3", "by 4"]
    assert [panel.get_xlabel() for panel in panels] == ["0.00°", "1.00°", "2.00°", "3.00°", "4.00°"]
    places = [panel.get_position() for panel in panels]
    assert places[4].x0 == places[0].x0 and places[4].y1 < places[3].y0


def test_errors_over_the_z_angle_need_a_network(clouds, turned):
    assert draw_z_angles(evaluate(clouds, [turned(1.0)], z_angles=True)) is None


def test_errors_over_the_z_angle(clouds, monkeypatch, turned):
    from jetnormal.evaluation import trials
    from jetnormal.evaluation.zangles import ZAngles

    def angles(estimator, cloud):
        """Half of the points lie at 12 degrees, the others at 32; all lie at 1 degree after the transform."""
        rows = np.arange(100)
        return ZAngles(rows, np.where(rows < 50, 12, 32).astype(np.float32), np.full(100, 1, np.float32))

    monkeypatch.setattr(trials, "measure_z_angles", angles)
    figure = draw_z_angles(evaluate(clouds, [turned(4.0, "net")], z_angles=True))
    errors, density = figure.axes
    (line,) = errors.get_lines()
    assert line.get_xdata().tolist() == [2.5]
    assert line.get_ydata()[0] == pytest.approx((4 + 8) / 2, abs=1e-3)
    labels = [text.get_text() for text in density.get_legend().get_texts()]
    assert labels == ["net: plane of the patch  (50 % beyond 20°)", "net: learned transform  (0 % beyond 20°)"]


def test_of_long_names_the_end_is_shown(clouds, turned):
    name = "runs/" * 10 + "model.safetensors"
    figure = draw_heatmaps(evaluate(clouds, [turned(1.0, name)]), "ball", ["ball"])
    assert figure.axes[0].get_title() == "…s/runs/runs/model.safetensors"


def test_pictures_are_not_overwritten_unasked(tmp_path):
    check_plots(tmp_path, overwrite=False)
    (tmp_path / "mine.png").touch()
    with pytest.raises(InputError, match="holds pictures already; use `overwrite`"):
        check_plots(tmp_path, overwrite=False)
    check_plots(tmp_path, overwrite=True)
    with pytest.raises(InputError, match="is no folder"):
        check_plots(tmp_path / "mine.png", overwrite=True)


def test_absent_matplotlib_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(plots, "find_spec", lambda name: None)
    with pytest.raises(ResourceError, match=r"pip install 'jetnormal\[plots\]'"):
        check_plots(tmp_path, overwrite=False)
