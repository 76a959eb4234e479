from __future__ import annotations

import numpy as np
import pytest

from jetnormal.formats.pcpnet import (
    CATEGORIES,
    categorize,
    clean_twin,
    query_count,
    read_cloud,
    shape_of,
    split_name,
    write_cloud,
)


@pytest.mark.parametrize("category", CATEGORIES)
def test_names_tell_shape_and_category(category):
    assert split_name("star_ddist_sharp.v2" + CATEGORIES[category].ending) == ("star_ddist_sharp.v2", category)


def test_other_noise_levels_are_categories_of_their_own():
    assert split_name("a_noise_white_5.00e-02") == ("a", "noise 5.00e-02")


def test_category_lists_decide_before_names(tmp_path):
    (tmp_path / "testset_high_noise.txt").write_text("a\nof_another_folder\n")
    (tmp_path / "testset_no_noise.txt").write_text("a_ddist_minmax\n")
    names = ["a", "bb", "a_ddist_minmax", "a_noise_white_1.25e-03", "a_noise_white_5.00e-02"]
    assert list(categorize(tmp_path, names).values()) == ["high", "none", "none", "low", "noise 5.00e-02"]


def test_written_clouds_are_read_back(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3)).astype(np.float32).astype(np.float64)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    write_cloud(tmp_path, "a_1.2e-02", points, normals, np.array([3, 7, 49]))
    read_points, read_normals, queries = read_cloud(tmp_path, "a_1.2e-02")
    np.testing.assert_array_equal(read_points.astype(np.float32), points)
    np.testing.assert_allclose(read_normals, normals, atol=1e-8)
    np.testing.assert_array_equal(queries, [3, 7, 49])
    assert query_count(tmp_path, "a_1.2e-02") == 3
    assert query_count(tmp_path, "a_1.2e-02", all_points=True) == 50


def test_a_noisy_cloud_has_the_clean_one_as_its_twin(tmp_path):
    noisy = "ball_noise_white_6.00e-03"
    assert clean_twin(tmp_path, noisy) is None
    write_cloud(tmp_path, "ball", np.eye(3), np.eye(3), np.arange(3))
    assert clean_twin(tmp_path, noisy) == "ball"
    assert clean_twin(tmp_path, "ball") is None
    assert clean_twin(tmp_path, "ball_ddist_minmax") is None


def test_any_list_of_a_test_set_makes_a_category(tmp_path):
    for name, members in {"lidar": "a b", "outdoors": "a b c", "no_noise": "d", "all": "a b c d e"}.items():
        (tmp_path / f"testset_{name}.txt").write_text(members.replace(" ", "\n"))
    categories = categorize(tmp_path, ["a", "b", "c", "d", "e", "f_ddist_minmax"])
    assert categories == {
        "a": "lidar",
        "b": "lidar",
        "c": "outdoors",
        "d": "none",
        "e": "none",
        "f_ddist_minmax": "gradient",
    }


def test_shapes_of_categories():
    assert shape_of("cat_lidar", "lidar") == "cat"
    assert shape_of("cat_noise_white_6.00e-03", "medium") == "cat"
