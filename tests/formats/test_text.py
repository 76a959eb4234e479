from __future__ import annotations

import numpy as np
import pytest

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError
from jetnormal.formats import read, write

POINTS = [[1.0, 2.0, 3.5], [-4.0, 0.1, 1e-3]]


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3.5\n-4 0.1 1e-3\n",
        "1\t2\t3.5\n-4\t0.1\t1E-3",
        "1,2,3.5\n-4, 0.1, .1e-2\n\n\n",
        "1;2;3.5\r\n-4;0.1;0.001\r\n",
        "1;2;3,5\n-4;0,1;0,001\n",
        "  1   2 \t 3.5  \n\n  -4 0.1 +0.001\n",
        "x y z\n1 2 3.5\n-4 .1 1e-3\n",
        '"X","Y","Z"\n1,2,3.5\n-4,.1,1e-3\n',
        "//X Y Z\n2\n1 2 3.5\n-4 .1 1e-3\n",
        "2\n1 2 3.5\n-4 .1 1e-3\n",
        "# one\n1 2 3.5 // first\n# two\n-4 .1 1e-3 # last\n",
        "1D0 2d+0 0.35D1\n-4D0 1D-1 1.D-3\n",
        "1 2 3.5\r-4 .1 1e-3\r",
        "\ufeff1 2 3.5\n-4 .1 1e-3\n",
    ],
)
@pytest.mark.parametrize("suffix", [".xyz", ".TXT", ".csv"])
def test_layouts_that_hold_the_same_points(tmp_path, text, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(text.encode())
    cloud = read(path)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.normals is None
    assert cloud.attributes == {}
    write(cloud, tmp_path / f"b{suffix}")
    np.testing.assert_array_equal(read(tmp_path / f"b{suffix}").points, POINTS)


def attributes_of(tmp_path, text, suffix=".xyz"):
    path = tmp_path / f"a{suffix}"
    path.write_text(text)
    cloud = read(path)
    return {name: (values.dtype.name, values.tolist()) for name, values in cloud.attributes.items()}


def test_further_columns_are_attributes(tmp_path):
    found = attributes_of(tmp_path, "0 0 0 0.5 7\n1 1 1 nan -70000\n")
    assert found["column_5"] == ("int32", [7, -70000])
    assert found["column_4"][0] == "float64"
    assert found["column_4"][1][0] == 0.5


def test_three_last_columns_of_bytes_are_colours(tmp_path):
    assert attributes_of(tmp_path, "0 0 0 1 128 255\n1 1 1 0 0 9\n") == {
        "red": ("uint8", [1, 0]),
        "green": ("uint8", [128, 0]),
        "blue": ("uint8", [255, 9]),
    }


def test_pts_rows_hold_intensity_and_colours(tmp_path):
    found = attributes_of(tmp_path, "2\n0 0 0 -900 1 2 3\n1 1 1 5 0 0 9\n", ".pts")
    assert list(found) == ["intensity", "red", "green", "blue"]
    assert found["intensity"] == ("int32", [-900, 5])


def test_a_header_names_colours_normals_and_the_rest(tmp_path):
    text = "Point ID,X,Y,Z,R,G,B,Nx,Ny,Nz,time\n1,0,0,0,1,2,3,0,0,1,1700000000000000001\n"
    path = tmp_path / "a.csv"
    path.write_text(text)
    cloud = read(path)
    assert cloud.normals.tolist() == [[0, 0, 1]]
    assert list(cloud.attributes) == ["Point_ID", "red", "green", "blue", "time"]
    assert cloud.attributes["red"].dtype == np.uint8
    assert cloud.attributes["time"].tolist() == [1700000000000000001]  # beyond what a double can hold
    write(cloud, tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text() == text


def test_six_columns_of_unit_length_are_normals(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3 0 0.6 0.8\n4 5 6 nan nan nan\n7 8 9 0.577 0.577 0.577\n")
    normals = read(path).normals
    np.testing.assert_allclose(np.linalg.norm(normals[[0, 2]], axis=1), 1, atol=0.01)
    assert np.isnan(normals[1]).all()


def test_six_columns_of_other_lengths_are_attributes(tmp_path):
    assert list(attributes_of(tmp_path, "1 2 3 0 0.6 0.8\n7 8 9 0.5 0.5 0.5\n")) == [
        "column_4",
        "column_5",
        "column_6",
    ]


NORMALS = np.array([[0.0, 0, 1], [0, -1, 0]])


@pytest.mark.parametrize(
    ("suffix", "before", "after"),
    [
        (".xyz", "1 2 3\n4.5 5 6\n", "1 2 3 0 0 1\n4.5 5 6 0 -1 0\n"),
        (".txt", "# made\n1\t2\t3\t7\n4.5\t5\t6\t8\n", "# made\n1\t2\t3\t0\t0\t1\t7\n4.5\t5\t6\t0\t-1\t0\t8\n"),
        (".pts", "2\n1 2 3 7\n4.5 5 6 8\n", "2\n1 2 3 0 0 1 7\n4.5 5 6 0 -1 0 8\n"),
        (".csv", "id;X;Y;Z\n8;1;2;3\n9;4.5;5;6\n", "id;X;Y;Z;nx;ny;nz\n8;1;2;3;0;0;1\n9;4.5;5;6;0;-1;0\n"),
        (".csv", "1,2,3\n4.5,5,6\n", "x,y,z,nx,ny,nz\n1,2,3,0,0,1\n4.5,5,6,0,-1,0\n"),
        (".asc", "//X Y Z\n2\n1 2 3\n4.5 5 6\n", "//X Y Z nx ny nz\n2\n1 2 3 0 0 1\n4.5 5 6 0 -1 0\n"),
        (".xyz", "1 2 3 1 0 0 5\n4.5 5 6 1 0 0 6\n", "1 2 3 0 0 1 5\n4.5 5 6 0 -1 0 6\n"),
    ],
)
def test_normals_join_the_layout_of_the_file(tmp_path, suffix, before, after):
    path = tmp_path / f"a{suffix}"
    path.write_text(before)
    cloud = read(path)
    cloud.normals = NORMALS
    assert write(cloud, path, overwrite=True) == []
    assert path.read_text() == after
    np.testing.assert_array_equal(read(path).normals, NORMALS)


def test_coordinates_read_back_to_the_same_bits(tmp_path):
    points = np.random.default_rng(0).integers(0, 2**63, (30_000, 3), dtype=np.int64).view(np.float64)
    points[np.isnan(points)] = 1 / 3
    points[0] = [np.nan, np.inf, -np.inf]
    points[1] = [-0.0, 5e-324, 1.7976931348623157e308]
    write(Cloud(points), tmp_path / "a.xyz")
    assert read(tmp_path / "a.xyz").points.tobytes() == points.tobytes()


def test_new_files_name_their_columns_only_if_there_are_attributes(tmp_path):
    write(Cloud(np.ones((2, 3)), NORMALS), tmp_path / "plain.xyz")
    assert (tmp_path / "plain.xyz").read_text().startswith("1 1 1 0 0 1\n")
    write(Cloud(np.ones((2, 3)), NORMALS, {"label": np.array([3, 4])}), tmp_path / "named.xyz")
    assert (tmp_path / "named.xyz").read_text().startswith("# x y z nx ny nz label\n1 1 1 0 0 1 3\n")
    assert read(tmp_path / "named.xyz").attributes["label"].tolist() == [3, 4]


def test_names_without_rows_are_no_points(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z\n")
    cloud = read(tmp_path / "a.csv")
    assert len(cloud) == 0
    write(cloud, tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text() == "x,y,z\n"


def test_names_that_the_file_cannot_hold_are_told(tmp_path):
    """A PTS file, and one that had no names, stay without: whoever reads them must know the columns."""
    points, normals = np.eye(3), np.eye(3)
    cloud = Cloud(points, normals, {"curvature": np.array([0.5, 0.25, 0.125])})
    told = "the columns' names are not kept; they are x y z nx ny nz curvature"
    assert write(cloud, tmp_path / "a.pts") == [f"{tmp_path / 'a.pts'}: {told}"]
    (tmp_path / "b.xyz").write_text("1 0 0\n0 1 0\n0 0 1\n")
    nameless = read(tmp_path / "b.xyz")
    cloud = Cloud(nameless.points, normals, cloud.attributes, nameless.source)
    assert write(cloud, tmp_path / "c.xyz") == [f"{tmp_path / 'c.xyz'}: {told}"]


def test_columns_that_are_known_by_their_place_need_no_warning(tmp_path):
    colors = {name: np.full(3, 7, np.uint8) for name in ("red", "green", "blue")}
    cloud = Cloud(np.eye(3), np.eye(3), {"intensity": np.array([1.5, 2.5, 3.5])} | colors)
    assert write(cloud, tmp_path / "a.pts") == []
    (tmp_path / "b.xyz").write_text("1 0 0 0.1 9 9.5\n0 1 0 0.1 9 9.5\n")
    assert write(read(tmp_path / "b.xyz"), tmp_path / "c.xyz") == []


BAD = {
    "empty": (b"", "is empty"),
    "blank": (b" \n\n", "holds no points"),
    "comments alone": (b"# nothing\n", "holds no points"),
    "binary": (b"PK\x03\x04\0\0\0", "is not plain text"),
    "UTF-16": ("1 2 3\n".encode("utf-16"), "is not plain text"),
    "two columns": (b"1 2\n3 4\n", "line 1: 2 values; x, y and z are needed"),
    "word": (b"1 2 3\n4 five 6\n", "line 2: 'five' is not a number"),
    "word below a comment": (b"1 2 3\n# note\n\n4 five 6\n", "line 4: 'five' is not a number"),
    "underscore": (b"1 2 3\n4 5 1_000\n", "line 2: '1_000' is not a number"),
    "word at once": (b"1 two 3\n", "line 1: 'two' is not a number"),
    "short row": (b"1 2 3\n4 5\n7 8 9\n", "line 2: 2 values instead of 3"),
    "long row": (b"1,2,3\n4,5,6,7\n", "line 2: 4 values instead of 3"),
    "missing value": (b"1,2,3\n4,,6\n", "line 2: '' is not a number"),
    "decimal commas between blanks": (b"1,5 2,5 3,5\n", "line 1: '5 2' is not a number"),
    "names without z": (b"x y height\n1 2 3\n", "no column 'z' among x, y, height"),
    "names too few": (b"x y z\n1 2 3 4\n", "line 2: 4 values under 3 column names"),
    "two lines of names": (b"x y z\nm m m\n1 2 3\n", "line 2: 'm' is not a number"),
    "count too large": (b"3\n1 2 3\n4 5 6\n", "declares 3 points but holds 2"),
    "count too small": (b"1\n1 2 3\n4 5 6\n", "declares 1 points but holds 2"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_one_clear_line(tmp_path, case):
    data, message = BAD[case]
    path = tmp_path / "bad.xyz"
    path.write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
