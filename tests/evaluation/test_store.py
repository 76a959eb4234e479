from __future__ import annotations

import numpy as np
import pytest
import torch

from jetnormal import evaluate
from jetnormal.errors import InputError
from jetnormal.evaluation.store import Estimate, ResultStore
from jetnormal.networks.checkpoint import save_model
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig


@pytest.fixture
def estimations(monkeypatch):
    """Counts the clouds that an estimator is run on."""
    from jetnormal.estimators.patchwise import PatchEstimator

    calls = []
    run = PatchEstimator.__call__

    def counted(self, points, queries=None, advance=None):
        calls.append(self.name)
        return run(self, points, queries, advance)

    monkeypatch.setattr(PatchEstimator, "__call__", counted)
    return calls


@pytest.fixture
def checkpoint(tmp_path_factory):
    def write(seed=0):
        torch.manual_seed(seed)
        network = PatchFit(PatchFitConfig(neighbors=16, width=0.125, feature_transform=False, light=True))
        save_model(path, network, {})
        return path

    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    return write


def test_kept_normals_are_not_estimated_again(folder, estimations, tmp_path_factory):
    results = tmp_path_factory.mktemp("results")
    first = evaluate(folder, ["pca:k=12", "jet"], results=results).summary()
    assert len(estimations) == 14
    assert evaluate(folder, ["pca:k=12", "jet"], results=results).summary() == first  # the seconds, too
    assert len(estimations) == 14
    assert len(list(results.iterdir())) == 14


def test_an_interrupted_evaluation_goes_on_where_it_stopped(folder, estimations, tmp_path_factory):
    results = tmp_path_factory.mktemp("results")
    (folder / "bb.normals").rename(folder / "bb.kept")
    (folder / "bb.normals").write_text("damaged\n")
    with pytest.raises(InputError, match=r"bb\.normals"):
        evaluate(folder, ["pca"], results=results)
    assert len(estimations) == 6
    (folder / "bb.kept").replace(folder / "bb.normals")
    result = evaluate(folder, ["pca"], results=results).models[0]
    assert len(estimations) == 7
    assert len(result.clouds) == 7


def test_what_the_normals_depend_on_is_noticed(tmp_path, write_sphere, estimations, checkpoint, tmp_path_factory):
    results = tmp_path_factory.mktemp("results")
    write_sphere(tmp_path, "ball", queries=range(20))
    model = str(checkpoint())

    def estimates(**settings):
        before = len(estimations)
        evaluate(tmp_path, [model], results=results, **settings)
        return len(estimations) - before

    assert [estimates(), estimates()] == [1, 0]
    assert [estimates(all_points=True), estimates(orient="mst"), estimates(threads=1), estimates()] == [1, 1, 1, 0]
    (tmp_path / "ball.pidx").write_text("5\n")
    assert [estimates(), estimates(all_points=True)] == [1, 0]
    write_sphere(tmp_path, "ball", radius=2)
    assert [estimates(), estimates()] == [1, 0]
    checkpoint(seed=1)
    assert [estimates(), estimates()] == [1, 0]


def test_kept_normals_are_scored_against_the_normals_there_are(tmp_path, write_sphere, estimations, tmp_path_factory):
    results = tmp_path_factory.mktemp("results")
    write_sphere(tmp_path, "ball")
    good = evaluate(tmp_path, ["pca"], results=results).models[0].average.rmse
    normals = np.loadtxt(tmp_path / "ball.normals")
    np.savetxt(tmp_path / "ball.normals", np.roll(normals, 1, axis=0))
    assert evaluate(tmp_path, ["pca"], results=results).models[0].average.rmse > good + 20
    assert len(estimations) == 1


def test_damaged_files_are_replaced(tmp_path, write_sphere, estimations, tmp_path_factory, caplog):
    results = tmp_path_factory.mktemp("results")
    write_sphere(tmp_path, "ball")
    for content in (b"", b"PK\x03\x04 not more", None):
        evaluate(tmp_path, ["pca"], results=results)
        (path,) = results.iterdir()
        if content is not None:
            path.write_bytes(content)
    assert len(estimations) == 3
    assert caplog.text.count("damaged") == 2


def test_estimates_come_back_as_they_were(tmp_path):
    store = ResultStore(tmp_path / "new" / "folder")
    path = store.path("cloud_1.20e-02", {"model": "runs/a b/model.safetensors", "k": 3})
    assert path.parent == tmp_path / "new" / "folder"
    assert store.load(path, 2) is None
    normals = np.array([[0.6, 0, 0.8], [np.nan] * 3], np.float32)
    store.save(path, Estimate(normals, 7, 1 / 3))
    kept = store.load(path, 2)
    np.testing.assert_array_equal(kept.normals, normals)
    assert kept.normals.dtype == np.float32
    assert (kept.points, kept.seconds) == (7, 1 / 3)


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file/results: cannot be created"):
        ResultStore(tmp_path / "file" / "results")
