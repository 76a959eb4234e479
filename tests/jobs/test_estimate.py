"""The main job on arrays, clouds and files, with classical models: what they need no network for."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import sphere

import jetnormal
from jetnormal import Cloud, estimate, formats
from jetnormal.cloud import Source
from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.geometry.metrics import angles
from jetnormal.jobs.estimate import estimate_file
from jetnormal.jobs.options import EstimateOptions, FileOptions
from jetnormal.orientation.grazing import GRAZING


def test_normals_of_an_array_point_outwards():
    points = sphere(3000)
    normals = jetnormal.estimate(points, model="jet")
    assert normals.dtype == np.float64 and normals.shape == points.shape
    assert angles(normals, points, oriented=True).max() < 3


def test_normals_at_utm_coordinates_are_those_near_the_origin():
    points = np.round(sphere(3000), 6)
    near = estimate(points, model="jet")
    far = estimate(points + np.array([456_789.0, 5_432_109.0, 321.0]), model="jet")
    assert angles(near, far, oriented=True).max() < 1e-3


def test_rows_that_are_not_finite_keep_their_place_and_harm_no_other():
    points = sphere(1000)
    gappy = np.insert(points, [0, 500, 1000], [[np.nan] * 3, [np.inf, 0, 0], [0, 0, -np.inf]], axis=0)
    normals = estimate(gappy, model="pca")
    finite = np.isfinite(gappy).all(axis=1)
    assert np.isnan(normals[~finite]).all()
    assert np.array_equal(normals[finite], estimate(points, model="pca"))


def test_exact_duplicates_do_no_harm():
    points = sphere(1000)
    copies = np.r_[points, points[:50].repeat(100, axis=0)]
    normals = estimate(copies, model="pca")
    assert np.array_equal(normals[:1000], estimate(points, model="pca"))
    assert np.array_equal(normals[1000:], normals[:50].repeat(100, axis=0))


def test_minus_zero_is_zero():
    points = sphere(200)
    points[:, 2] = 0.0
    signed = points.copy()
    signed[::2, 2] = -0.0
    assert np.array_equal(estimate(np.r_[points, signed], model="pca")[:200], estimate(points, model="pca"))


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((1, 3)), np.eye(3)[:2], np.ones((50, 3))])
def test_fewer_than_three_different_points_are_an_input_error(points):
    with pytest.raises(InputError, match="at least 3"):
        estimate(points, model="pca")


def test_collinear_points_get_nan_and_a_warning(tmp_path):
    formats.write(Cloud(np.arange(90.0)[:, None] * [1, 1, 0]), tmp_path / "line.xyz")
    summary = estimate_file(tmp_path / "line.xyz", tmp_path / "out.ply", EstimateOptions(model="pca"))
    assert summary["valid"] == 0 and "collinear" in summary["warnings"][0]
    assert np.isnan(formats.read(tmp_path / "out.ply").normals).all()


def test_a_small_cloud_gets_what_can_be_done_and_a_warning(tmp_path):
    formats.write(Cloud(sphere(12)), tmp_path / "few.xyz")
    summary = estimate_file(tmp_path / "few.xyz", tmp_path / "out.xyz", EstimateOptions(model="jet"))
    assert summary["valid"] == 12 and "12 points" in summary["warnings"][0]


@pytest.mark.parametrize("count", [3, 5, 20])
def test_a_cloud_too_small_for_a_network_gets_jets(tmp_path, count):
    formats.write(Cloud(sphere(count)), tmp_path / "few.xyz")
    summary = estimate_file(tmp_path / "few.xyz", tmp_path / "out.xyz", EstimateOptions())
    assert summary["valid"] == count
    assert summary["warnings"][0] == (
        f"{count} points are too few for cloudfit: jets of {min(count, 10)} neighbors were fitted instead"
    )


def test_a_file_keeps_all_that_it_held_and_gains_normals(tmp_path):
    rng = np.random.default_rng(1)
    attributes = {"red": rng.integers(0, 256, 500, dtype=np.uint8), "label": rng.integers(-9, 9, 500, dtype=np.int16)}
    formats.write(Cloud(sphere(500), attributes=attributes), tmp_path / "in.ply")
    options = EstimateOptions(model="jet", curvature=True, confidence=True)
    summary = estimate_file(tmp_path / "in.ply", tmp_path / "out.ply", options)
    before, after = formats.read(tmp_path / "in.ply"), formats.read(tmp_path / "out.ply")
    assert np.array_equal(after.points, before.points)
    for name, values in before.attributes.items():
        assert np.array_equal(after.attributes[name], values) and after.attributes[name].dtype == values.dtype
    assert set(after.attributes) - set(before.attributes) == {
        "curvature", "curvature_max", "curvature_min", "confidence",
    }  # fmt: skip
    assert summary["points"] == summary["valid"] == 500
    assert summary["orient"]["used"] == "global" and summary["model"] == "jet:k=60,order=2"
    assert set(summary["seconds"]) == {"read", "clean", "model", "estimate", "orient", "write"}


def test_curvature_follows_the_oriented_normal():
    cloud = Cloud(sphere(4000) * 2)
    outward = estimate(cloud, model="jet", curvature=True)
    inward = estimate(cloud, model="jet", curvature=True, viewpoint=(0.0, 0.0, 0.0))
    assert np.median(outward.attributes["curvature"]) == pytest.approx(-0.5, rel=0.02)
    assert np.median(inward.attributes["curvature"]) == pytest.approx(0.5, rel=0.02)
    assert (inward.attributes["curvature_max"] >= inward.attributes["curvature_min"]).all()


def test_auto_orientation_takes_the_viewpoint_of_a_pcd_file(tmp_path):
    text = "\n".join(f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in sphere(400))
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 400\nHEIGHT 1\n"
    for viewpoint, expected in (("0 0 0", "global"), ("0 0 9", "viewpoint")):
        source = tmp_path / f"{expected}.pcd"
        source.write_text(f"{header}VIEWPOINT {viewpoint} 1 0 0 0\nPOINTS 400\nDATA ascii\n{text}\n")
        summary = estimate_file(source, tmp_path / f"{expected}_n.pcd", EstimateOptions(model="pca"))
        assert summary["orient"]["used"] == expected
    written = formats.read(tmp_path / "viewpoint_n.pcd")
    sights = [0, 0, 9] - written.points
    cosine = (written.normals * sights).sum(1) / np.linalg.norm(sights, axis=1)
    assert (cosine > -GRAZING).all()  # where the sight line grazes the surface, neighbors count as well


def test_up_and_none():
    points = sphere(500)
    assert (estimate(points, model="pca", orient="up")[:, 2] >= 0).all()
    unoriented = estimate(points, model="pca", orient="none")
    assert angles(unoriented, estimate(points, model="pca")).max() < 1e-4


@pytest.mark.parametrize(
    "options",
    [
        {"orient": "viewpoint"},
        {"orient": "up", "viewpoint": (0.0, 0.0, 1.0)},
        {"orient": "north"},
        {"viewpoint": (np.nan, 0.0, 0.0)},
        {"viewpoint": (1.0, 2.0)},
        {"viewpoint": ["a", "b", "c"]},
        {"viewpoint": [10**400, 0, 0]},
        {"viewpoint": np.array(3.0)},
        {"orient": np.array(["up"])},
        {"threads": 0},
        {"batch_size": -1},
        {"model": "pca", "curvature": True},
        {"model": "pca", "order": 3},
    ],
)
def test_options_that_make_no_sense_are_usage_errors(options):
    with pytest.raises(UsageError):
        estimate(sphere(100), **({"model": "jet"} | options))


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"encoding": "morse"}, UsageError),
        ({"model": "pca:order=2"}, UsageError),
        ({"model": "nonesuch"}, ModelError),
    ],
)
def test_wrong_options_are_told_before_the_cloud_is_read(tmp_path, options, error):
    (tmp_path / "in.xyz").write_text("this is no cloud")
    encoding = options.pop("encoding", None)
    options = EstimateOptions(**({"model": "pca"} | options))
    with pytest.raises(error):
        estimate_file(tmp_path / "in.xyz", tmp_path / "out.ply", options, FileOptions(encoding=encoding))


def test_coordinates_whose_squares_overflow_are_an_input_error():
    points = sphere(100)
    points[50] = 1e300
    with pytest.raises(InputError, match=r"1e\+300"):
        estimate(points, model="pca")
    assert angles(estimate(sphere(100) * 1e100, model="pca"), estimate(sphere(100), model="pca")).max() < 1e-3


@pytest.mark.filterwarnings("error")
def test_a_viewpoint_beyond_all_numbers_is_far_away():
    far, farther = (estimate(sphere(100), model="pca", viewpoint=(x, 0.0, 0.0)) for x in (1e9, 1e308))
    np.testing.assert_array_equal(farther, far)


def test_a_viewpoint_of_the_file_that_is_not_finite_is_none():
    cloud = Cloud(sphere(100), source=Source(viewpoint=(np.nan, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)))
    with pytest.raises(UsageError, match="`viewpoint`"):
        estimate(cloud, model="pca", orient="viewpoint")
    assert np.isfinite(estimate(cloud, model="pca").normals).all()


def test_a_replaced_attribute_is_told(tmp_path):
    formats.write(Cloud(sphere(100), attributes={"confidence": np.zeros(100)}), tmp_path / "in.ply")
    for confidence, told in ((False, []), (True, ["attribute 'confidence' of the input is replaced"])):
        options = EstimateOptions(model="pca", confidence=confidence)
        summary = estimate_file(tmp_path / "in.ply", tmp_path / "out.ply", options, overwrite=True)
        assert summary["warnings"] == told
        assert formats.read(tmp_path / "out.ply").attributes["confidence"].any() == confidence


def test_errors_name_the_file_and_leave_nothing_behind(tmp_path):
    formats.write(Cloud(np.ones((9, 3))), tmp_path / "same.ply")
    with pytest.raises(InputError, match=r"same\.ply"):
        estimate_file(tmp_path / "same.ply", tmp_path / "out.ply", EstimateOptions(model="pca"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["same.ply"]


def test_an_existing_output_is_refused_before_any_work(tmp_path):
    (tmp_path / "out.ply").write_text("precious")
    with pytest.raises(InputError, match="`overwrite`"):
        estimate_file(tmp_path / "missing.ply", tmp_path / "out.ply", EstimateOptions())
    assert (tmp_path / "out.ply").read_text() == "precious"


def test_the_same_input_gives_the_same_bytes(tmp_path):
    formats.write(Cloud(sphere(800)), tmp_path / "in.ply")
    for name in ("a.ply", "b.ply"):
        estimate_file(tmp_path / "in.ply", tmp_path / name, EstimateOptions(model="jet", confidence=True))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("model", ["cloudfit", "jet"])
@pytest.mark.parametrize("size", [1e-100, 1e-45, 1e39, 1e149])
def test_the_size_of_a_cloud_does_not_matter(model, size):
    points = sphere(300)
    exact = 2.0 ** round(np.log2(size))
    assert np.array_equal(estimate(points * exact, model=model), estimate(points, model=model))


@pytest.mark.parametrize("model", ["cloudfit", "jet"])
def test_an_outlier_far_away_harms_no_other_point(model):
    points = sphere(300)
    normals = estimate(np.concatenate([points, [[1e140, 0, 0]]]), model=model)[:-1]
    assert np.isfinite(normals).all()
    assert np.sqrt(np.mean(np.square(angles(normals, points)))) < 6


@pytest.mark.parametrize("model", ["cloudfit", "jet", "pca", "deepfit-small"])
def test_points_of_a_line_have_no_normal_whatever_the_model(model):
    points = np.random.default_rng(0).random(200)[:, None] * [0.1, 0.7, 0.3] + [5, 6, 7]
    assert np.isnan(estimate(points, model=model)).all()


def test_curvatures_are_in_the_unit_of_the_cloud():
    sizes = [2.0**-60, 1.0, 2.0**20]
    clouds = [estimate(Cloud(sphere(300) * size), model="jet", curvature=True) for size in sizes]
    small, normal, large = (np.median(cloud.attributes["curvature"]) for cloud in clouds)
    assert normal == small / 2.0**60 == large * 2.0**20
