"""Files read and written in pieces are the files read and written at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats import open_stream, read, write, write_pieces
from jetnormal.formats.scans import Pose, ScansExtra

PIECE = 37
TARGETS = ["a.las", "a.laz", "a.ply", "a.pcd", "a.npy", "a.xyz", "a.csv", "a.pts"]


@pytest.fixture
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    points = np.round(rng.uniform(-10, 10, (200, 3)), 3)
    colors = {name: rng.integers(0, 256, 200).astype(np.uint8) for name in ("red", "green", "blue")}
    return Cloud(points, None, {"intensity": rng.integers(0, 60_000, 200).astype(np.uint16), **colors})


def joined(pieces: list[Cloud]) -> Cloud:
    attributes = {name: np.concatenate([p.attributes[name] for p in pieces]) for name in pieces[0].attributes}
    source = replace(pieces[0].source, sensors=None)
    normals = None if pieces[0].normals is None else np.concatenate([p.normals for p in pieces])
    return Cloud(np.concatenate([p.points for p in pieces]), normals, attributes, source)


def assert_pieces_are_the_whole(path: Path) -> None:
    whole, stream = read(path), open_stream(path)
    found = list(stream.pieces(PIECE))
    assert stream.points == len(whole) and 0 < max(map(len, found)) <= PIECE
    again = joined(found)
    assert again.points.tobytes() == whole.points.tobytes()
    assert (again.normals is None) == (whole.normals is None)
    assert whole.normals is None or again.normals.tobytes() == whole.normals.tobytes()
    assert list(again.attributes) == list(whole.attributes)
    for key, values in whole.attributes.items():
        assert {piece.attributes[key].dtype for piece in found} == {values.dtype}
        assert again.attributes[key].tobytes() == values.astype(again.attributes[key].dtype).tobytes()
    for name in ("columns", "width", "height", "point_dtype", "normal_dtype", "comments", "notes"):
        assert all(getattr(piece.source, name) == getattr(whole.source, name) for piece in found)


READ = [*((name, None) for name in [*TARGETS, "a.npz"]), ("a.ply", "ascii"), ("a.pcd", "ascii")]


@pytest.mark.parametrize(("name", "encoding"), READ)
def test_pieces_are_the_whole(tmp_path, cloud, name, encoding):
    cloud.points[77] = np.nan if name not in ("a.las", "a.laz") else 0
    write(cloud, tmp_path / name, encoding=encoding)
    assert_pieces_are_the_whole(tmp_path / name)


def test_text_with_faces_and_blank_lines_comes_in_pieces(tmp_path):
    """The faces follow the vertices; every piece knows of them, and an error names the line."""
    rows = [f"{i / 7!r} {i} {1 / (i + 1)!r} {i}" for i in range(100)]
    head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty double y\nproperty float z\n"
    head += "property uchar label\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    faces = "\n3 0 1 2\n3 2 1 0\n"
    path = tmp_path / "a.ply"
    path.write_text(head.format(100) + "\n".join([*rows[:50], "", " ", *rows[50:]]) + "\n" + faces)
    assert_pieces_are_the_whole(path)
    assert next(open_stream(path).pieces(PIECE)).source.extra == read(path).source.extra
    path.write_text(head.format(103) + "\n".join(rows) + "\n" + faces)
    with pytest.raises(InputError, match="declares 103 points but holds 102"):
        open_stream(path)
    path.write_text(
        head.format(100) + "\n".join([*rows[:50], "", *rows[50:80], "1 2 3 256", *rows[81:]]) + "\n" + faces
    )
    for reads in (read, lambda path: list(open_stream(path).pieces(PIECE))):
        with pytest.raises(InputError, match="line 92: '256' is not a number of type uint8"):
            reads(path)


@pytest.mark.parametrize(
    ("rows", "message"), [(99, "declares 100 points but holds 99"), (101, "holds more than the 100")]
)
def test_text_of_another_length_is_refused_before_the_first_piece(tmp_path, rows, message):
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 100\nHEIGHT 1\nPOINTS 100\nDATA ascii\n"
    (tmp_path / "a.pcd").write_text(head + "12.5 3.25 1.5\n" * rows)
    for reads in (read, open_stream):
        with pytest.raises(InputError, match=message):
            reads(tmp_path / "a.pcd")


GRID = np.random.default_rng(0).normal(size=(20, 10, 3))
ROWS = GRID.reshape(-1, 3).astype(np.float32)
RECORDS = np.zeros(200, [("x", "<f4"), ("Y", ">f8"), ("z", "<f4"), ("pair", "<u2", 2)])
RECORDS["x"], RECORDS["Y"], RECORDS["z"], RECORDS["pair"] = *ROWS.T, np.arange(400).reshape(200, 2)
PAIRS = np.arange(1200, dtype=">i4").reshape(200, 3, 2)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
@pytest.mark.parametrize(
    "arrays",
    [
        {"points": ROWS, "normals": ROWS / 2, "label": np.arange(200), "scale": np.ones(2)},
        {"xyz": np.asfortranarray(ROWS), "pairs": np.asfortranarray(PAIRS), "more": PAIRS, "flags": np.arange(200) > 9},
        {"points": GRID, "intensity": np.arange(200, dtype=np.uint8)},
        {"points": np.c_[ROWS, ROWS / np.linalg.norm(ROWS, axis=1, keepdims=True), np.full(200, 7.5)]},
        {"x": ROWS[:, 0], "y": GRID.reshape(-1, 3)[:, 1], "Z": ROWS[:, 2], "time": np.arange(200)},
        {"points": RECORDS},
        {"points": RECORDS.reshape(20, 10)},
    ],
)
def test_arrays_of_an_archive_come_in_pieces(tmp_path, save, arrays):
    save(tmp_path / "a.npz", **arrays)
    assert_pieces_are_the_whole(tmp_path / "a.npz")


def test_archives_that_cannot_be_read_in_pieces(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, points=np.asfortranarray(GRID))
    with pytest.raises(InputError, match="'points' is a grid that lies column by column"):
        open_stream(path)
    np.savez(path, points=ROWS, names=np.array(["a", {}] * 100, object))
    with pytest.raises(InputError, match="Python objects"):
        open_stream(path)
    np.savez_compressed(path, points=ROWS)
    damaged = bytearray(path.read_bytes())
    damaged[1000:1100] = bytes(100)
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"not a readable \.npz file"):
        list(open_stream(path).pieces(PIECE))


@pytest.mark.parametrize("name", ["a.e57", "a.ptx"])
def test_scans_come_one_by_one(tmp_path, name):
    """Two scans of which one has no color, and points that were not measured: the pieces are the whole."""
    path = tmp_path / name
    if name == "a.ptx":
        head = "{}\n1\n{} 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n{} 0 0 1\n"
        rows = [f"{i} {i * i} 1 0.5" for i in range(50)] + ["0 0 0 0"]
        colored = [f"{row} 1 2 {i}" for i, row in enumerate(rows)]
        path.write_text("".join(head.format(51, x, x) + "\n".join(r) + "\n" for x, r in ((5, rows), (0, colored))))
    else:
        pytest.importorskip("pye57")
        rng = np.random.default_rng(0)
        poses = (Pose(translation=np.array([1.0, 2, 3])), Pose())
        scan = np.repeat(np.arange(2, dtype=np.uint16), 100)
        source = Source(format="e57", extra=ScansExtra(poses))
        write(Cloud(rng.random((200, 3)), None, {"intensity": rng.random(200), "scan": scan}, source), path)
    whole, stream = read(path), open_stream(path)
    found = list(stream.pieces(PIECE))
    again = joined(found)
    assert stream.points == len(whole) == len(again) and max(map(len, found)) <= PIECE
    assert again.points.tobytes() == whole.points.tobytes() and again.source.notes == whole.source.notes
    assert list(again.attributes) == list(whole.attributes)
    for key, values in whole.attributes.items():
        assert again.attributes[key].dtype == values.dtype
        np.testing.assert_array_equal(again.attributes[key], values)
    np.testing.assert_array_equal(np.concatenate([p.source.sensors for p in found]), whole.source.sensors)


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_written_in_pieces_has_the_same_bytes(tmp_path, cloud, name):
    """Read from the file's own format, so that the new one has nothing to choose."""
    write(cloud, tmp_path / name)
    whole = read(tmp_path / name)
    normals = np.tile([0.0, 0.6, 0.8], (200, 1))
    expected = Cloud(whole.points, normals, whole.attributes, whole.source)
    warnings = write(expected, tmp_path / f"whole_{name}")
    pieces = (
        Cloud(piece.points, normals[: len(piece)], piece.attributes, piece.source)
        for piece in open_stream(tmp_path / name).pieces(PIECE)
    )
    box = np.array([whole.points.min(axis=0), whole.points.max(axis=0)])
    said = write_pieces(pieces, 200, box, tmp_path / f"pieces_{name}")
    assert [line.replace("pieces_", "whole_") for line in said] == warnings
    assert (tmp_path / f"pieces_{name}").read_bytes() == (tmp_path / f"whole_{name}").read_bytes()


def test_a_column_of_text_keeps_one_type(tmp_path):
    """Its first pieces hold integers, a later one does not."""
    path = tmp_path / "a.xyz"
    rows = [f"{i / 7} {i} 0 {i if i < 900 else i + 0.5}" for i in range(1000)]
    path.write_text("\n".join(rows))
    stream = open_stream(path)
    kinds = {piece.attributes["column_4"].dtype for piece in stream.pieces(100)}
    assert kinds == {np.dtype(np.float64)} and stream.points == 1000


def test_what_cannot_be_read_in_pieces_says_so(tmp_path, cloud):
    write(cloud, tmp_path / "a.pcd", encoding="binary_compressed")
    with pytest.raises(InputError, match=r"not read in pieces: a compressed PCD"):
        open_stream(tmp_path / "a.pcd")
    cloud.attributes["list"] = np.array([np.arange(i % 3, dtype="i4") for i in range(200)], object)
    write(cloud, tmp_path / "a.ply")
    with pytest.raises(InputError, match=r"not read in pieces: its vertices have lists"):
        open_stream(tmp_path / "a.ply")


def test_formats_without_pieces_name_those_that_have_them(tmp_path, cloud):
    with pytest.raises(InputError, match=r"kitti file is not read in pieces; .*\.las \.laz .*\.ply"):
        open_stream(tmp_path / "a.bin", format="kitti")
    with pytest.raises(InputError, match=r"not written in pieces; .*\.las \.laz .*\.ply"):
        write_pieces(iter([cloud]), 200, np.zeros((2, 3)), tmp_path / "a.npz")


def test_a_type_that_depends_on_values_is_refused(tmp_path):
    """Integers of 64 bits become 32 bits in a PLY file if all fit."""
    small, large = (Cloud(np.zeros((2, 3)), None, {"time": np.array([1, n])}) for n in (2, 2**40))
    with pytest.raises(InputError, match="'time' depends on its values"):
        write_pieces(iter([small, large]), 4, np.zeros((2, 3)), tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize(("name", "encoding"), READ)
def test_a_file_without_points_has_one_piece(tmp_path, name, encoding):
    path = tmp_path / name
    write(Cloud(np.empty((0, 3)), None, {"intensity": np.empty(0, np.uint16)}), path, encoding=encoding)
    stream = open_stream(path)
    assert stream.points == 0 and [len(piece) for piece in stream.pieces(PIECE)] == [0]
