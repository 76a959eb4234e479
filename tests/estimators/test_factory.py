"""Estimators by name: what a user types, and what the estimator then says of itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import jetnormal
from jetnormal.errors import ModelError, UsageError
from jetnormal.estimators.factory import make_estimator, model_file, model_names, spelled_out
from jetnormal.estimators.patchwise import network_estimator
from jetnormal.networks.checkpoint import save_model
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig

TINY = PatchFitConfig(neighbors=64, width=0.125, transform_width=0.125, feature_transform=False, light=True)
POINTS = np.random.default_rng(0).normal(size=(200, 3))


@pytest.fixture
def model(tmp_path):
    """A model file in a folder, or of a name, that begins like a classical fit."""

    def save(folder: str):
        torch.manual_seed(0)
        path = tmp_path / folder / "model.safetensors"
        path.parent.mkdir()
        save_model(path, PatchFit(TINY), {})
        return path

    return save


@pytest.mark.parametrize(
    "model",
    [
        "pca:k=2",
        "jet:order=5",
        "pca:order=2",
        "jet:iterations=2",
        "pca:k=many",
        "pca:q=3",
        "jet:k=-4",
        "jet:k=5",
        "jet:k=14,order=4",
        "pca:k=²",
        f"pca:k={'9' * 5000}",
        "cloudfit:k=9",
        "cloudfit:iterations=2",
    ],
)
def test_bad_settings_are_usage_errors(model):
    with pytest.raises(UsageError):
        make_estimator(model)


@pytest.mark.parametrize("option", [{"order": 3}, {"k": 30}])
def test_an_option_that_a_model_lacks_is_named(option):
    with pytest.raises(UsageError, match=next(iter(option))):
        make_estimator("cloudfit", **option)


def test_classical_fits_run_on_the_cpu_and_say_so():
    with pytest.raises(UsageError, match="jet runs on the CPU"):
        make_estimator("jet", device="cuda")


@pytest.mark.parametrize(
    ("typed", "meant"), [("jt", "jet"), ("cloudfti", "cloudfit"), ("PCA", "pca"), ("deepfit", "deepfit-small")]
)
def test_an_unknown_model_is_answered_with_the_likely_one(typed, meant):
    with pytest.raises(ModelError, match=f"pca, jet.*did you mean {meant}") as error:
        make_estimator(typed)
    assert typed in str(error.value)


def test_a_name_like_no_other_is_answered_with_all():
    with pytest.raises(ModelError, match=r"nonesuch: .*cloudfit.*pca, jet\) nor a model file$"):
        make_estimator("nonesuch")


def test_names_are_those_that_can_be_made():
    assert {"cloudfit", "pca", "jet"} <= set(model_names())
    for name in model_names():
        assert make_estimator(name).name.startswith(name)
        assert (model_file(name) is None) == (name in ("pca", "jet"))


def test_presets_are_the_neighborhoods_of_the_literature():
    names = spelled_out(["cloudfit", "traditional"])
    assert names == ["cloudfit", "pca:small", "pca:medium", "pca:large", "jet:small", "jet:medium", "jet:large"]
    assert [make_estimator(name).neighbors for name in names[1:]] == [18, 112, 450, 18, 122, 450]
    assert make_estimator("jet:medium").name == "jet:k=122,order=2"
    assert model_file("jet:medium") is None
    with pytest.raises(ModelError):
        make_estimator("pca:tiny")


def test_a_model_file_takes_settings_after_a_colon(model):
    path = model("own")
    found = make_estimator(f"{path}:iterations=2")(POINTS)
    torch.manual_seed(0)
    expected = network_estimator("tiny", PatchFit(TINY).for_inference(), iterations=2)(POINTS)
    assert np.abs(found.normals - expected.normals).max() < 1e-5


def test_only_a_plane_has_no_curvature(model):
    assert not make_estimator("pca").has_curvature
    assert make_estimator("pca")(POINTS).curvatures is None
    for name in ("jet", "cloudfit", str(model("pca_run"))):
        estimator = make_estimator(name)
        assert estimator.has_curvature
        assert estimator(POINTS).curvatures.shape == (200, 2)


def test_the_path_of_a_model_file_does_not_change_what_it_can(model, monkeypatch):
    monkeypatch.chdir(model("pca_run").parents[1])
    model("jet_run")
    cloud = jetnormal.Cloud(POINTS)
    assert "curvature" in jetnormal.estimate(cloud, model="pca_run/model.safetensors", curvature=True).attributes
    assert make_estimator("jet_run/model.safetensors").min_points == make_estimator("cloudfit").min_points == 64
    few = jetnormal.estimate(POINTS[:20], model="jet_run/model.safetensors")
    assert np.array_equal(few, jetnormal.estimate(POINTS[:20], model="jet", k=10))
