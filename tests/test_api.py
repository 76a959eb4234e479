"""The library as a program uses it."""

from __future__ import annotations

import inspect
import pickle
import subprocess
import sys
import warnings

import numpy as np
import pytest
from shapes import sphere

import jetnormal
from jetnormal import Cloud, EstimateOptions, Estimator, JetnormalWarning, Mesh, ReconstructOptions, Result, api
from jetnormal.errors import InputError, UsageError
from jetnormal.estimators import factory
from jetnormal.geometry.metrics import angles
from jetnormal.jobs import prediction
from jetnormal.jobs.options import NormalOptions
from jetnormal.support.open3d_loader import import_open3d


def test_an_estimator_gives_all_there_is_to_know():
    points = np.r_[2 * sphere(600), [[np.nan] * 3]]
    with pytest.warns(JetnormalWarning, match="no finite coordinates"):
        result = Estimator("jet", k=40)(points)
    assert isinstance(result, Result) and result.model == "jet:k=40,order=2" and result.orient == "global"
    assert angles(result.normals[:-1], sphere(600), oriented=True).max() < 5
    assert np.median(result.curvatures[:-1]) == pytest.approx(-0.5, rel=0.1)
    assert result.valid.sum() == 600 and not result.valid[-1]
    assert np.nanmin(result.confidence) > 0.8 and np.nanmin(result.sign_confidence) > 0
    assert [len(values) for values in (result.confidence, result.curvatures, result.sign_confidence)] == [601] * 3
    assert set(result.seconds) == {"clean", "estimate", "orient"} and len(result.warnings) == 1
    assert repr(result).startswith("<Result: 601 normals by jet:k=40,order=2, signs by global")


def counted(monkeypatch) -> list[NormalOptions]:
    """A list that grows with every model that is loaded."""
    loads = []
    prepare = prediction.prepare_estimator
    for module in (api, prediction):
        monkeypatch.setattr(module, "prepare_estimator", lambda options: loads.append(options) or prepare(options))
    return loads


def test_an_estimator_loads_its_model_once(monkeypatch):
    loads = counted(monkeypatch)
    est = Estimator("cloudfit", threads=1)
    first, second = est(sphere(600)), est(sphere(600))
    assert len(loads) == 1 and np.array_equal(first.normals, second.normals)


def test_an_estimator_can_be_sent_to_another_process():
    est = Estimator("jet", k=20, viewpoint=(0, 0, 9.0))
    again = pickle.loads(pickle.dumps(est))
    assert again == est and np.array_equal(again(sphere(600)).normals, est(sphere(600)).normals)


def test_a_model_is_a_name_or_a_path_and_no_network(tmp_path):
    path = tmp_path / "own.safetensors"
    path.write_bytes(factory.model_file("deepfit-small").read_bytes())
    assert Estimator(path).model == str(path)
    with pytest.raises(
        UsageError, match=r"`model` is a name or the path of a model file, not a PatchFit; `estimate` and"
    ):
        jetnormal.estimate(sphere(600), model=jetnormal.load_model("deepfit-small"))


def test_estimate_keeps_its_model_until_the_file_changes(monkeypatch, tmp_path):
    loads = counted(monkeypatch)
    prediction._kept.cache_clear()
    path = tmp_path / "own.safetensors"
    path.write_bytes(factory.model_file("deepfit-small").read_bytes())
    few = sphere(80)
    for options in ({}, {"orient": "up"}, {"viewpoint": (0, 0, 9.0)}):
        jetnormal.estimate(few, model=str(path), **options)
    assert len(loads) == 1
    path.write_bytes(factory.model_file("adafit-small").read_bytes())
    jetnormal.estimate(few, model=str(path))
    assert len(loads) == 2


def test_the_viewpoint_may_change_from_call_to_call():
    est = Estimator("pca")
    for viewpoint in ([0, 0, 0], np.array([0, 0, 0.0])):
        inward = est(sphere(600), viewpoint=viewpoint)
        assert (
            inward.orient == "viewpoint"
            and inward.reason == "the viewpoint was given"
            and ((inward.normals * sphere(600)).sum(axis=1) < 0).all()
        )
    outward = est(sphere(600))
    assert outward.orient == "global" and outward.reason == "its surfaces are closed"


def test_results_have_the_shape_of_the_points():
    points = sphere(600).reshape(20, 30, 3)
    result = Estimator("jet")(points)
    assert result.normals.shape == (20, 30, 3) and result.confidence.shape == (20, 30)
    assert result.curvatures.shape == (20, 30, 2)
    normals = jetnormal.estimate(points, model="jet")
    assert normals.dtype == np.float64 and np.array_equal(normals, result.normals)
    assert jetnormal.estimate(sphere(600).tolist(), model="jet").shape == (600, 3)


def test_a_path_becomes_a_cloud(tmp_path):
    jetnormal.write(Cloud(sphere(600)), tmp_path / "in.ply")
    for path in (tmp_path / "in.ply", str(tmp_path / "in.ply")):
        found = jetnormal.estimate(path, model="pca", confidence=True)
        assert isinstance(found, Cloud) and set(found.attributes) == {"confidence"}


def test_an_open3d_cloud_comes_back_as_one():
    open3d = import_open3d() or pytest.skip("Open3D cannot be loaded")
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(sphere(600)))
    found = jetnormal.estimate(points, model="jet")
    assert isinstance(found, open3d.geometry.PointCloud)
    assert np.allclose(np.asarray(found.normals), jetnormal.estimate(sphere(600), model="jet"))
    tensor = open3d.t.geometry.PointCloud.from_legacy(points)
    found = jetnormal.estimate(tensor, model="jet", curvature=True, confidence=True)
    assert {"normals", "curvature", "confidence"} <= set(found.point) and "normals" not in tensor.point


@pytest.mark.parametrize("option", ["curvature", "confidence", "sign_confidence"])
def test_attributes_of_plain_points_are_refused_not_dropped(option):
    with pytest.raises(UsageError, match=f"`{option}` is an attribute of a cloud"):
        jetnormal.estimate(sphere(600), **{"model": "jet", option: True})


def test_warnings_name_the_line_of_the_caller():
    collinear = np.arange(90.0)[:, None] * [1, 1, 0]
    calls = [
        lambda: jetnormal.estimate(collinear, model="pca"),
        lambda: Estimator("pca")(collinear),
        lambda: jetnormal.reconstruct(Cloud(sphere(600), 7 * sphere(600)), depth=5),
    ]
    for call in calls[: 2 if import_open3d() is None else 3]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            call()
        assert caught and all(issubclass(one.category, JetnormalWarning) for one in caught)
        assert {one.filename for one in caught} == {__file__}


def test_warnings_can_be_silenced_by_their_class(recwarn):
    warnings.simplefilter("ignore", JetnormalWarning)
    jetnormal.estimate(sphere(12), model="jet")
    assert not recwarn


def test_meshes_are_written_too(tmp_path):
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.ones((3, 3)))
    jetnormal.write(mesh, tmp_path / "m.ply")
    with pytest.raises(InputError, match="`overwrite`"):
        jetnormal.write(mesh, tmp_path / "m.ply")
    with pytest.warns(JetnormalWarning, match="STL has no colors"):
        jetnormal.write(mesh, tmp_path / "m.stl")
    with pytest.raises(UsageError, match="`encoding`"):
        jetnormal.write(mesh, tmp_path / "m.off", encoding="ascii")
    jetnormal.write(sphere(5), tmp_path / "points.xyz")
    assert np.allclose(jetnormal.read(tmp_path / "points.xyz").points, sphere(5))


@pytest.mark.parametrize(
    ("function", "kind"), [(jetnormal.estimate, EstimateOptions), (jetnormal.reconstruct, ReconstructOptions)]
)
def test_signatures_and_help_tell_every_option(function, kind):
    first, *rest = inspect.signature(function).parameters.values()
    expected = inspect.signature(kind).parameters
    assert first.name == "points"
    assert {one.name: one.default for one in rest} == {name: one.default for name, one in expected.items()}
    assert "Literal['auto', 'global'" in str(inspect.signature(function))
    for name in expected:
        assert f"\n    {name}: " in function.__doc__


def test_a_misspelt_option_is_answered_with_the_right_one():
    with pytest.raises(TypeError, match=r"estimate\(\) has no option 'modle'; did you mean model\?"):
        jetnormal.estimate(sphere(600), modle="jet")
    with pytest.raises(TypeError, match="thread"):
        Estimator("jet", thread=1)


@pytest.mark.parametrize(
    "options", [{"orient": "north"}, {"k": 0}, {"threads": 1.5}, {"viewpoint": (1.0, 2.0)},
                {"viewpoint": (np.nan,) * 3}, {"viewpoint": "0,0,1"}, {"orient": "up", "viewpoint": (0, 0, 1)}]
)  # fmt: skip
def test_options_that_make_no_sense_are_told_by_name(options):
    with pytest.raises(UsageError, match=next(iter(options))):
        NormalOptions(**options)


def test_representations_are_short():
    assert repr(Estimator("jet", k=9, threads=1)) == "Estimator(model='jet', k=9, threads=1)"
    cloud = Cloud(sphere(600), sphere(600), {"red": np.zeros(600)})
    assert repr(cloud) == "<Cloud: 600 points with normals and attributes red>"
    assert repr(Cloud(sphere(600))) == "<Cloud: 600 points>"
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    assert repr(mesh) == "<Mesh: 3 vertices, 1 faces>"


def test_the_package_runs_as_a_program():
    result = subprocess.run(
        [sys.executable, "-m", "jetnormal", "--version"], capture_output=True, text=True, timeout=120
    )
    assert result.stdout == f"jetnormal {jetnormal.__version__}\n"
