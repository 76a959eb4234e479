from __future__ import annotations

import numpy as np
import pytest

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, UsageError
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


def test_three_last_columns_of_bytes_are_colors(tmp_path):
    assert attributes_of(tmp_path, "0 0 0 1 128 255\n1 1 1 0 0 9\n") == {
        "red": ("uint8", [1, 0]),
        "green": ("uint8", [128, 0]),
        "blue": ("uint8", [255, 9]),
    }


def test_pts_rows_hold_intensity_and_colors(tmp_path):
    found = attributes_of(tmp_path, "2\n0 0 0 -900 1 2 3\n1 1 1 5 0 0 9\n", ".pts")
    assert list(found) == ["intensity", "red", "green", "blue"]
    assert found["intensity"] == ("int32", [-900, 5])


def test_a_header_names_colors_normals_and_the_rest(tmp_path):
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
        (".pts", "2\n1 2 3 7\n4.5 5 6 8\n", "2\n1 2 3 7 0 0 1\n4.5 5 6 8 0 -1 0\n"),
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
    told = "the columns' names are not kept; they are x y z"
    assert write(cloud, tmp_path / "a.pts") == [f"{tmp_path / 'a.pts'}: {told} curvature nx ny nz"]
    (tmp_path / "b.xyz").write_text("1 0 0\n0 1 0\n0 0 1\n")
    nameless = read(tmp_path / "b.xyz")
    cloud = Cloud(nameless.points, normals, cloud.attributes, nameless.source)
    assert write(cloud, tmp_path / "c.xyz") == [f"{tmp_path / 'c.xyz'}: {told} nx ny nz curvature"]


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
    "names without z": (b"x y depth\n1 2 3\n", "no column 'z' among x, y, depth"),
    "names too few": (b"x y z\n1 2 3 4\n", "line 2: 4 values under 3 column names"),
    "two lines of names": (b"x y z\nm m m\n1 2 3\n", "line 2: 'm' is not a number"),
    "a number of 5000 digits": (b"1" * 5000 + b"\n1 2 3\n", "line 1: 1 values; x, y and z are needed"),
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


def numbered(rows=12, first=1):
    return "".join(f"{index + first} {index * index} {-index} 5 7.5\n" for index in range(rows))


@pytest.mark.parametrize("first", [0, 1])
def test_a_first_column_that_counts_is_the_number_of_the_point(tmp_path, first):
    (tmp_path / "a.xyz").write_text(numbered(first=first))
    cloud = read(tmp_path / "a.xyz")
    assert cloud.points[3].tolist() == [9, -3, 5]
    assert cloud.attributes["point_number"].tolist() == list(range(first, 12 + first))
    assert list(cloud.attributes) == ["point_number", "column_5"]
    assert "counts the points" in cloud.source.notes[0]
    write(cloud, tmp_path / "b.xyz")
    assert (tmp_path / "b.xyz").read_text().startswith(f"0 0 5 {first} 7.5\n")


@pytest.mark.parametrize("text", [numbered(9), numbered().replace("3 4", "4 4"), "1 2 3\n" * 20])
def test_few_or_uneven_numbers_are_coordinates(tmp_path, text):
    (tmp_path / "a.xyz").write_text(text)
    cloud = read(tmp_path / "a.xyz")
    assert cloud.points[0, 0] == 1 and cloud.source.notes == ()


def test_columns_by_their_order(tmp_path):
    (tmp_path / "a.txt").write_text(numbered())
    cloud = read(tmp_path / "a.txt", columns="time,x,z,-,y")
    assert cloud.points[3].tolist() == [9, 7.5, -3] and list(cloud.attributes) == ["time"]
    (tmp_path / "b.csv").write_text("a,b,c\n1,2,3\n")
    assert read(tmp_path / "b.csv", columns="z,y,x").points.tolist() == [[3, 2, 1]]


def test_columns_by_their_names(tmp_path):
    (tmp_path / "a.csv").write_text("X;Lage rechts;Hoch;NN\n1;2,5;3;4\n")
    cloud = read(tmp_path / "a.csv", columns="x=lage rechts,y=Hoch,z=NN")
    assert cloud.points.tolist() == [[2.5, 3, 4]] and cloud.attributes["x_2"].tolist() == [1]
    cloud.normals = np.array([[0.0, 0, 1]])
    write(cloud, tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text() == "X;Lage rechts;Hoch;NN;nx;ny;nz\n1;2.5;3;4;0;0;1\n"


@pytest.mark.parametrize(
    "names",
    [
        "Easting,Northing,Height",
        "RECHTSWERT,Hochwert,Höhe",
        "X [m],Y [m],Z [m]",
        "East,North,Elevation",
        "e,n,h",
        "X,Y,Z",
    ],
)
def test_the_words_of_surveyors(tmp_path, names):
    (tmp_path / "a.csv").write_text(f"id,{names},Intensity\n7,1,2,3,9\n")
    cloud = read(tmp_path / "a.csv")
    assert cloud.points.tolist() == [[1, 2, 3]] and list(cloud.attributes) == ["id", "Intensity"]
    write(cloud, tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text() == f"id,{names},Intensity\n7,1,2,3,9\n"


@pytest.mark.parametrize("text", ["1,5 2,25 3\n", "x\ty\tz\n1,5\t2,25\t3\n", "1,5;2,25;3\n"])
def test_decimal_commas(tmp_path, text):
    (tmp_path / "a.txt").write_text(text)
    assert read(tmp_path / "a.txt", decimal="comma").points.tolist() == [[1.5, 2.25, 3]]


def test_semicolons_and_a_decimal_point_that_the_user_insists_on(tmp_path):
    (tmp_path / "a.txt").write_text("1,5;2,25;3\n")
    with pytest.raises(InputError, match="'1,5' is not a number"):
        read(tmp_path / "a.txt", decimal="point")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": "x,y"}, "'z' is missing"),
        ({"columns": "x,y,z,x"}, "'x' comes twice"),
        ({"columns": "x,y,z"}, "names 3 columns, but there are 5"),
        ({"columns": "x,y,z,"}, "give names like"),
        ({"columns": "x=a,y"}, "give names like"),
        ({"columns": "x=a,y=b,z=c"}, "has no line of names"),
        ({"decimal": "dot"}, "point or comma"),
    ],
)
def test_columns_that_do_not_fit(tmp_path, options, message):
    (tmp_path / "a.xyz").write_text(numbered())
    with pytest.raises(UsageError, match=message):
        read(tmp_path / "a.xyz", **options)


def test_only_text_has_such_columns(tmp_path):
    write(Cloud(np.eye(3)), tmp_path / "a.ply")
    with pytest.raises(UsageError, match="text files"):
        read(tmp_path / "a.ply", columns="x,y,z")


def test_without_names_the_coordinates_come_first(tmp_path):
    """Whatever their order in a file that names them."""
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\n"
        + "".join(f"property float {name}\n" for name in ("intensity", "nx", "ny", "nz", "x", "y", "z"))
        + "end_header\n7 0 0 1 1 2 3\n8 0 0 1 4 5 6\n"
    )
    cloud = read(tmp_path / "a.ply")
    for suffix, row in ((".xyz", "1 2 3 0 0 1 7"), (".pts", "1 2 3 7 0 0 1"), (".xyzn", "1 2 3 0 0 1 7")):
        write(cloud, tmp_path / f"b{suffix}")
        assert row in (tmp_path / f"b{suffix}").read_text()
        again = read(tmp_path / f"b{suffix}")
        assert again.points.tolist() == [[1, 2, 3], [4, 5, 6]] and again.normals.tolist() == [[0, 0, 1]] * 2


def test_xyzn_holds_normals_of_any_length(tmp_path):
    (tmp_path / "a.xyzn").write_text("1 2 3 0 0 5\n")
    assert read(tmp_path / "a.xyzn").normals.tolist() == [[0, 0, 5]]


def test_pts_rows_end_with_normals(tmp_path):
    colors = {name: np.full(3, 7, np.uint8) for name in ("red", "green", "blue")}
    cloud = Cloud(np.eye(3), np.eye(3), {"label": np.arange(3), **colors, "intensity": np.array([1.5, 2.5, 3.5])})
    del cloud.attributes["label"]
    write(cloud, tmp_path / "a.pts")
    assert (tmp_path / "a.pts").read_text().splitlines()[1] == "1 0 0 1.5 7 7 7 1 0 0"
    again = read(tmp_path / "a.pts")
    assert list(again.attributes) == ["intensity", "red", "green", "blue"] and (again.normals == np.eye(3)).all()


def test_the_smallest_integer_stays(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,id\n0,0,0,-9223372036854775808\n1,1,1,3\n")
    assert read(tmp_path / "a.csv").attributes["id"].tolist() == [-(2**63), 3]


def test_names_that_would_break_the_line_of_names(tmp_path):
    values = np.arange(3)
    cloud = Cloud(np.eye(3), attributes=dict.fromkeys(("a,b", "7", "a;b", "c#d", "e//f", "1e5"), values))
    warnings = write(cloud, tmp_path / "a.csv")
    assert len(warnings) == 6
    names = ["x", "y", "z", "a_b", "column_7", "a_b_2", "c_d", "e_f", "column_1e5"]
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == ",".join(names)
    again = read(tmp_path / "a.csv")
    assert list(again.attributes) == names[3:] and all((v == values).all() for v in again.attributes.values())


def test_names_of_digits_are_names(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,z,7\n0,1,2,3\n")
    assert read(tmp_path / "a.csv").attributes["7"].tolist() == [3]


def test_many_columns_of_large_numbers_are_parsed_twice_and_no_more(tmp_path, monkeypatch):
    parsed = []
    loadtxt = np.loadtxt
    monkeypatch.setattr(np, "loadtxt", lambda *args, **options: parsed.append(1) or loadtxt(*args, **options))
    (tmp_path / "a.txt").write_text("0 0 0" + " 999999999999999999 999999999999999999999 1e18 1.5e17" * 500 + "\n")
    attributes = read(tmp_path / "a.txt").attributes
    assert len(parsed) == 2
    assert sum(values.dtype == np.int64 and values[0] == 999999999999999999 for values in attributes.values()) == 500


def test_integers_beyond_doubles_are_exact_beside_large_coordinates(tmp_path):
    (tmp_path / "a.txt").write_text("# x y z label\n1e+16 0 0 9007199254740993\n")
    assert read(tmp_path / "a.txt").attributes["label"].tolist() == [9007199254740993]
