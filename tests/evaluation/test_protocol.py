from __future__ import annotations

import json

import numpy as np
import pytest

from jetnormal import evaluate
from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.evaluation.options import EvaluateOptions


def test_rmse_is_the_angle_by_which_the_normals_are_turned(tmp_path, write_sphere, turned):
    write_sphere(tmp_path, "sphere")
    found = [evaluate(tmp_path, [turned(degrees)]).models[0].clouds["sphere"] for degrees in (2.0, 7.0, 80.0, 100.0)]
    assert [one.scores.rmse for one in found] == pytest.approx([2, 7, 80, 80], abs=1e-3)
    assert [one.scores.median for one in found] == pytest.approx([2, 7, 80, 80], abs=1e-3)
    assert [one.scores.pgp5 for one in found] == [1, 0, 0, 0]
    assert [one.scores.pgp10 for one in found] == [1, 1, 0, 0]
    assert [one.scores.auc for one in found] == pytest.approx([28 / 30, 23 / 30, 0, 0], abs=1e-4)
    np.testing.assert_allclose(found[1].errors, np.full(400, 7.0), atol=1e-3)


def test_categories_are_means_of_clouds_and_the_average_is_theirs(folder, turned):
    (result,) = evaluate(folder, [turned(1.0)]).models
    rmse = {name: one.rmse for name, one in result.categories.items()}
    expected = {"none": 2.0, "low": 4.0, "medium": 5.0, "high": 6.0, "gradient": 7.0, "striped": 8.0}
    assert list(rmse) == list(expected)
    assert rmse == pytest.approx(expected, abs=1e-3)
    assert result.average.rmse == pytest.approx(32 / 6, abs=1e-3)  # over the clouds it would be 34 / 7
    assert result.average.pgp10 == 1
    assert 2 / 6 <= result.average.pgp5 <= 3 / 6  # rounding decides on the cloud that is turned by 5 degrees


def test_curves_are_shares_below_each_threshold(folder, turned):
    (result,) = evaluate(folder, [turned(1.0)]).models
    thresholds = np.arange(0, 30.5, 0.5)
    exact = np.isin(thresholds, [1, 3])  # where rounding decides
    expected = (0.5 * (thresholds > 1) + 0.5 * (thresholds > 3))[~exact]
    np.testing.assert_array_equal(result.curves["none"][~exact], expected)
    assert result.curves["striped"][[15, 17]].tolist() == [0, 1]


def test_only_the_points_of_the_pidx_file_count_unless_all_do(tmp_path, write_sphere, turned):
    write_sphere(tmp_path, "every")
    write_sphere(tmp_path, "some", 2, queries=[7, 300, 7])
    (result,) = evaluate(tmp_path, [turned(1.0)]).models
    assert result.points == 400 + 3
    assert result.clouds["some"].scores.rmse == pytest.approx(2, abs=1e-3)
    assert [len(result.clouds[name].errors) for name in ("every", "some")] == [400, 3]
    (result,) = evaluate(tmp_path, [turned(1.0)], all_points=True).models
    assert [len(result.clouds[name].errors) for name in ("every", "some")] == [400, 400]


def test_models_are_told_apart_and_timed(folder, turned):
    evaluation = evaluate(folder, [turned(1.0, "good"), turned(2.0, "bad"), "pca:k=12"])
    assert [one.model for one in evaluation.models] == ["good", "bad", "pca:k=12"]
    good, bad, _ = evaluation.models
    assert bad.average.rmse == pytest.approx(2 * good.average.rmse, abs=1e-3)
    for one in evaluation.models:
        assert one.points == 7 * 400
        assert one.points_per_second == one.points / one.seconds > 0


def test_pca_has_the_error_of_planes_fitted_one_by_one(tmp_path, write_sphere):
    write_sphere(tmp_path, "sphere", queries=range(50))
    (result,) = evaluate(tmp_path, ["pca:k=20"], device="cpu", threads=1).models
    points, normals = (np.loadtxt(tmp_path / f"sphere.{suffix}") for suffix in ("xyz", "normals"))
    cosines = []
    for point, normal in zip(points[:50], normals[:50], strict=True):
        near = points[np.argsort(np.linalg.norm(points - point, axis=1))[:20]]
        cosines.append(abs(np.linalg.svd(near - near.mean(axis=0))[2][2] @ normal))
    expected = np.sqrt(np.mean(np.degrees(np.arccos(cosines)) ** 2))
    assert result.average.rmse == pytest.approx(expected, abs=1e-3)


def test_noisy_clouds_are_compared_with_their_clean_twin(tmp_path, write_sphere, turned):
    write_sphere(tmp_path, "ball", count=4000)
    name = "ball_noise_white_1.20e-02"
    points, normals = (np.loadtxt(tmp_path / f"ball.{suffix}")[:500] for suffix in ("xyz", "normals"))
    np.savetxt(tmp_path / f"{name}.xyz", 1.5 * points)
    np.savetxt(tmp_path / f"{name}.normals", np.roll(normals, 1, axis=0))  # the noise took the points elsewhere
    (result,) = evaluate(tmp_path, [turned(4.0)]).models
    assert result.clouds["ball"].scores.clean_rmse is None
    assert result.clouds[name].scores.clean_rmse == pytest.approx(6, abs=1e-3)
    assert result.clouds[name].scores.rmse > 40
    assert result.average.clean_rmse == pytest.approx(6, abs=1e-3)  # over the categories that have it


def test_signs_are_scored_up_to_a_flip_of_the_whole_cloud(tmp_path, write_sphere, turned):
    write_sphere(tmp_path, "sphere", count=800, queries=range(0, 800, 2))
    (result,) = evaluate(tmp_path, [turned(5.0)]).models
    assert result.average.oriented_rmse is None
    assert result.average.sign_accuracy is None
    (result,) = evaluate(tmp_path, [turned(5.0)], orient="mst").models
    assert result.points == 800  # signs spread through all points
    assert len(result.clouds["sphere"].errors) == 400
    assert result.average.sign_accuracy == 1
    assert result.average.oriented_rmse == pytest.approx(5, abs=1e-3)
    (result,) = evaluate(tmp_path, [turned(5.0)], orient="up").models  # right for the upper half only
    assert result.average.sign_accuracy == pytest.approx(0.5, abs=0.1)
    assert result.average.oriented_rmse > 100


def test_the_list_chooses_the_clouds(folder, turned):
    assert len(evaluate(folder, [turned(1.0)]).clouds) == 7
    (folder / "testset_all.txt").write_text("a\nbb\n")
    (folder / "one.txt").write_text("a_ddist_minmax\n")
    assert evaluate(folder, [turned(1.0)]).clouds == {"a": "none", "bb": "none"}
    assert evaluate(folder, [turned(1.0)], list_file="one.txt").clouds == {"a_ddist_minmax": "gradient"}


def test_summary_is_json_and_holds_all_scores(folder, turned):
    summary = json.loads(json.dumps(evaluate(folder, [turned(1.0)]).summary()))
    assert summary["data"] == str(folder)
    assert summary["clouds"]["a_ddist_minmax_layers"] == "striped"
    assert summary["thresholds"][:3] == [0, 0.5, 1]
    (model,) = summary["models"]
    assert model["model"] == "turned"
    assert model["clouds"]["bb"]["rmse"] == pytest.approx(3, abs=1e-3)
    assert model["categories"]["none"]["pgp5"] == 1
    assert model["average"]["rmse"] == pytest.approx(32 / 6, abs=1e-3)
    assert len(model["good_points"]["high"]) == len(summary["thresholds"]) == 61
    assert model["points_per_second"] > 0


def test_missing_and_mismatched_files_are_named(folder, turned):
    with pytest.raises(InputError, match="absent: no such folder"):
        evaluate(folder / "absent", [turned(1.0)])
    with pytest.raises(InputError, match=r"absent\.txt: no such list"):
        evaluate(folder, [turned(1.0)], list_file="absent.txt")
    (folder / "bb.normals").write_text("0 0 1\n")
    with pytest.raises(InputError, match=r"bb\.normals: 1 normals for 400 points"):
        evaluate(folder, [turned(1.0)])
    for index in ("400", "-1", "1.5"):
        (folder / "a.pidx").write_text(index)
        with pytest.raises(InputError, match=r"a\.pidx: an index is not among the 400 points"):
            evaluate(folder, [turned(1.0)])
    (folder / "a.xyz").write_text("1e300 0 0\n" * 400)
    with pytest.raises(InputError, match=r"a\.xyz: coordinates as large as 1e\+300"):
        evaluate(folder, [turned(1.0)])
    (folder / "a.xyz").unlink()
    (folder / "testset_all.txt").write_text("a\nbb\n")
    with pytest.raises(InputError, match=r"testset_all\.txt: .*lack.*: a$"):
        evaluate(folder, [turned(1.0)])


def test_unusable_models_and_settings_are_refused(folder):
    with pytest.raises(UsageError, match="no model"):
        evaluate(folder, [])
    with pytest.raises(UsageError, match="pca is given twice"):
        evaluate(folder, ["pca", "jet", "pca"])
    with pytest.raises(ModelError, match="absent"):
        evaluate(folder, ["absent"])
    with pytest.raises(UsageError, match="orient is one of none, global, mst, viewpoint, up, not 'sideways'"):
        evaluate(folder, ["pca"], orient="sideways")


@pytest.fixture
def ball(tmp_path, write_sphere):
    """A folder with a sphere, of which every second point is evaluated."""
    write_sphere(tmp_path, "ball", count=800, queries=range(0, 800, 2))
    return tmp_path


def test_normals_of_another_program_are_scored_beside_ours(ball, turned, tmp_path_factory):
    theirs = tmp_path_factory.mktemp("theirs")
    true = np.loadtxt(ball / "ball.normals")
    for rows in (true, true[::2]):  # of all points, or of those evaluated
        np.savetxt(theirs / "ball.normals", rows * [1, 1, -1])
        found = evaluate(ball, [turned(3.0)], normals=(f"theirs={theirs}",), orient="mst")
        assert [one.model for one in found.models] == ["turned", "theirs"]
        expected = np.degrees(np.arccos(np.abs((true[::2] * (true[::2] * [1, 1, -1])).sum(axis=1))))
        _, other = found.models
        assert other.average.rmse == pytest.approx(np.sqrt(np.mean(expected**2)), abs=1e-3)
        assert 0.5 <= other.average.sign_accuracy < 0.8  # its own signs, not ours
        assert other.seconds is None and other.points_per_second is None
    alone = evaluate(ball, [], normals=(f"theirs={theirs}",))
    assert json.loads(json.dumps(alone.summary()))["models"][0]["seconds"] is None


def test_normals_of_another_program_that_do_not_fit_are_named(ball, tmp_path):
    with pytest.raises(InputError, match="nowhere: no such folder"):
        evaluate(ball, ["pca"], normals=("theirs=nowhere",))
    with pytest.raises(UsageError, match="NAME=DIR"):
        evaluate(ball, ["pca"], normals=("theirs",))
    with pytest.raises(UsageError, match="pca is given twice"):
        evaluate(ball, ["pca"], normals=(f"pca={ball}",))
    other = tmp_path / "other"
    other.mkdir()
    with pytest.raises(InputError, match=r"other/ball\.normals"):
        evaluate(ball, [], normals=(f"theirs={other}",))
    np.savetxt(other / "ball.normals", np.eye(3))
    with pytest.raises(InputError, match=r"ball\.normals: 3 rows for 800 points, 400 of them evaluated"):
        evaluate(ball, [], normals=(f"theirs={other}",))


def test_exported_normals_are_scored_alike(ball, turned, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "new"
    first = evaluate(ball, [turned(5.0, "runs/own:k=3")], export_normals=folder)
    (made,) = folder.iterdir()
    assert made.name == "runs_own_k=3" and [path.name for path in made.iterdir()] == ["ball.normals"]
    again = evaluate(ball, [], normals=(f"exported={made}",))
    assert again.models[0].average.rmse == pytest.approx(first.models[0].average.rmse, abs=1e-3)


def test_exported_normals_do_not_replace_those_of_others(ball, turned, tmp_path):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    np.savetxt(theirs / "ball.normals", np.ones((800, 3)))
    before = (theirs / "ball.normals").read_bytes()
    with pytest.raises(InputError, match=r"ball\.normals: already exists; use `overwrite`"):
        evaluate(ball, [], normals=(f"theirs={theirs}",), export_normals=tmp_path)
    assert (theirs / "ball.normals").read_bytes() == before
    evaluate(ball, [], normals=(f"theirs={theirs}",), export_normals=tmp_path, overwrite=True)
    assert len(np.loadtxt(theirs / "ball.normals")) == 400  # those evaluated
    with pytest.raises(UsageError, match=r"runs/a and runs_a would both be exported to .*runs_a/ball\.normals"):
        evaluate(ball, [turned(5.0, "runs/a"), turned(5.0, "runs_a")], export_normals=tmp_path)


def test_threads_are_bounded():
    with pytest.raises(UsageError, match="threads is 1 to 1024"):
        EvaluateOptions(threads=100_000)
