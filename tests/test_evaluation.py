from __future__ import annotations

import json

import numpy as np
import pytest

from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.evaluation import categorize, evaluate
from jetnormal.pcpnet import query_count
from jetnormal.prediction import Prediction


def write_sphere(folder, name, radius=1.0, count=400, queries=None):
    """A sphere in PCPNet's layout: the normals are the directions of the points."""
    normals = np.random.default_rng(len(name)).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.savetxt(folder / f"{name}.xyz", radius * normals, fmt="%.9f")
    np.savetxt(folder / f"{name}.normals", normals, fmt="%.9f")
    if queries is not None:
        np.savetxt(folder / f"{name}.pidx", queries, fmt="%d")


class Turned:
    """The true normals of a sphere of radius r, turned by r times an angle, every other one upside down."""

    neighbors = 10

    def __init__(self, degrees, name="turned"):
        self.degrees, self.name = degrees, name

    def __call__(self, points, queries=None, advance=None):
        points = points[queries]
        radius = np.linalg.norm(points, axis=1, keepdims=True)
        aside = np.cross(points, np.roll(points, 1, axis=1))
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        angle = np.radians(self.degrees * radius)
        normals = np.cos(angle) * points / radius + np.sin(angle) * aside
        normals[::2] *= -1
        advance(len(points))
        normals = normals.astype(np.float32)
        return Prediction(normals, normals, np.ones(len(points), np.float32), None)


@pytest.fixture
def folder(tmp_path):
    """Two clouds without noise, radius 1 and 3, and one of each other kind, radius 4 to 8."""
    write_sphere(tmp_path, "a", 1)
    write_sphere(tmp_path, "bb", 3)
    endings = ["_noise_white_1.25e-03", "_noise_white_6.00e-03", "_noise_white_1.20e-02"]
    for radius, ending in enumerate([*endings, "_ddist_minmax", "_ddist_minmax_layers"], start=4):
        write_sphere(tmp_path, f"a{ending}", radius)
    return tmp_path


def test_rmse_is_the_angle_by_which_the_normals_are_turned(tmp_path):
    write_sphere(tmp_path, "sphere")
    scores = [evaluate(tmp_path, [Turned(degrees)]).models[0].clouds["sphere"] for degrees in (2.0, 7.0, 80.0, 100.0)]
    assert [one.rmse for one in scores] == pytest.approx([2, 7, 80, 80], abs=1e-3)
    assert [one.pgp5 for one in scores] == [1, 0, 0, 0]
    assert [one.pgp10 for one in scores] == [1, 1, 0, 0]


def test_categories_are_means_of_clouds_and_the_average_is_theirs(folder):
    (scores,) = evaluate(folder, [Turned(1.0)]).models
    rmse = {name: one.rmse for name, one in scores.categories.items()}
    expected = {"none": 2.0, "low": 4.0, "medium": 5.0, "high": 6.0, "gradient": 7.0, "striped": 8.0}
    assert list(rmse) == list(expected)
    assert rmse == pytest.approx(expected, abs=1e-3)
    assert scores.average.rmse == pytest.approx(32 / 6, abs=1e-3)  # over the clouds it would be 34 / 7
    assert scores.average.pgp10 == 1
    assert 2 / 6 <= scores.average.pgp5 <= 3 / 6  # rounding decides on the cloud that is turned by 5 degrees


def test_only_the_points_of_the_pidx_file_count(tmp_path):
    write_sphere(tmp_path, "all")
    write_sphere(tmp_path, "some", 2, queries=[7, 300, 7])
    (scores,) = evaluate(tmp_path, [Turned(1.0)]).models
    assert scores.points == 400 + 3
    assert scores.clouds["some"].rmse == pytest.approx(2, abs=1e-3)
    assert [query_count(tmp_path, name) for name in ("all", "some")] == [400, 3]


def test_models_are_told_apart_and_timed(folder):
    evaluation = evaluate(folder, [Turned(1.0, "good"), Turned(2.0, "bad"), "pca:k=12"])
    assert [one.model for one in evaluation.models] == ["good", "bad", "pca:k=12"]
    good, bad, _ = evaluation.models
    assert bad.average.rmse == pytest.approx(2 * good.average.rmse, abs=1e-3)
    for one in evaluation.models:
        assert one.points == 7 * 400
        assert one.points_per_second == one.points / one.seconds > 0


def test_pca_has_the_error_of_planes_fitted_one_by_one(tmp_path):
    write_sphere(tmp_path, "sphere", queries=range(50))
    (scores,) = evaluate(tmp_path, ["pca:k=20"], device="cpu", threads=1).models
    points, normals = (np.loadtxt(tmp_path / f"sphere.{suffix}") for suffix in ("xyz", "normals"))
    cosines = []
    for point, normal in zip(points[:50], normals[:50], strict=True):
        near = points[np.argsort(np.linalg.norm(points - point, axis=1))[:20]]
        cosines.append(abs(np.linalg.svd(near - near.mean(axis=0))[2][2] @ normal))
    expected = np.sqrt(np.mean(np.degrees(np.arccos(cosines)) ** 2))
    assert scores.average.rmse == pytest.approx(expected, abs=1e-3)


def test_category_lists_decide_before_names(folder):
    (folder / "testset_high_noise.txt").write_text("a\nof_another_folder\n")
    (folder / "testset_no_noise.txt").write_text("a_ddist_minmax\n")
    names = ["a", "bb", "a_ddist_minmax", "a_noise_white_1.25e-03", "a_noise_white_5.00e-02"]
    assert list(categorize(folder, names).values()) == ["high", "none", "none", "low", "noise 5.00e-02"]


def test_the_list_chooses_the_clouds(folder):
    assert len(evaluate(folder, [Turned(1.0)]).clouds) == 7
    (folder / "testset_all.txt").write_text("a\nbb\n")
    (folder / "one.txt").write_text("a_ddist_minmax\n")
    assert evaluate(folder, [Turned(1.0)]).clouds == {"a": "none", "bb": "none"}
    assert evaluate(folder, [Turned(1.0)], list_file="one.txt").clouds == {"a_ddist_minmax": "gradient"}


def test_summary_is_json_and_holds_all_scores(folder):
    summary = json.loads(json.dumps(evaluate(folder, [Turned(1.0)]).summary()))
    assert summary["data"] == str(folder)
    assert summary["clouds"]["a_ddist_minmax_layers"] == "striped"
    (model,) = summary["models"]
    assert model["model"] == "turned"
    assert model["clouds"]["bb"]["rmse"] == pytest.approx(3, abs=1e-3)
    assert model["categories"]["none"]["pgp5"] == 1
    assert model["average"]["rmse"] == pytest.approx(32 / 6, abs=1e-3)
    assert model["points_per_second"] > 0


def test_missing_and_mismatched_files_are_named(folder):
    with pytest.raises(InputError, match="absent: no such folder"):
        evaluate(folder / "absent", [Turned(1.0)])
    with pytest.raises(InputError, match=r"absent\.txt: no such list"):
        evaluate(folder, [Turned(1.0)], list_file="absent.txt")
    (folder / "bb.normals").write_text("0 0 1\n")
    with pytest.raises(InputError, match=r"bb\.normals: 1 normals for 400 points"):
        evaluate(folder, [Turned(1.0)])


def test_unusable_models_are_refused(folder):
    with pytest.raises(UsageError, match="no model"):
        evaluate(folder, [])
    with pytest.raises(UsageError, match="pca is given twice"):
        evaluate(folder, ["pca", "jet", "pca"])
    with pytest.raises(ModelError, match="absent"):
        evaluate(folder, ["absent"])
