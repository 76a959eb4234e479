"""Files read and written in pieces are the files read and written at once."""

from __future__ import annotations

from dataclasses import replace

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
    return Cloud(np.concatenate([p.points for p in pieces]), None, attributes, source)


@pytest.mark.parametrize("name", TARGETS)
def test_pieces_are_the_whole(tmp_path, cloud, name):
    path = tmp_path / name
    write(cloud, path)
    whole, stream = read(path), open_stream(path)
    found = list(stream.pieces(PIECE))
    assert stream.points == 200 and max(map(len, found)) <= PIECE
    again = joined(found)
    assert again.points.tobytes() == whole.points.tobytes()
    assert list(again.attributes) == list(whole.attributes)
    for key, values in whole.attributes.items():
        assert again.attributes[key].dtype == values.dtype
        np.testing.assert_array_equal(again.attributes[key], values)


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


@pytest.mark.parametrize("name", ["a.ply", "a.pcd"])
def test_what_cannot_be_read_in_pieces_says_so(tmp_path, cloud, name):
    write(cloud, tmp_path / name, encoding="ascii")
    with pytest.raises(InputError, match="not read in pieces"):
        open_stream(tmp_path / name)


def test_formats_without_pieces_name_those_that_have_them(tmp_path, cloud):
    with pytest.raises(InputError, match=r"numpy file is not read in pieces; .*\.las \.laz .*\.ply"):
        open_stream(tmp_path / "a.npz")
    with pytest.raises(InputError, match=r"not written in pieces; .*\.las \.laz .*\.ply"):
        write_pieces(iter([cloud]), 200, np.zeros((2, 3)), tmp_path / "a.npz")


def test_a_type_that_depends_on_values_is_refused(tmp_path):
    """Integers of 64 bits become 32 bits in a PLY file if all fit."""
    small, large = (Cloud(np.zeros((2, 3)), None, {"time": np.array([1, n])}) for n in (2, 2**40))
    with pytest.raises(InputError, match="'time' depends on its values"):
        write_pieces(iter([small, large]), 4, np.zeros((2, 3)), tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize("name", TARGETS)
def test_a_file_without_points_has_one_piece(tmp_path, name):
    path = tmp_path / name
    write(Cloud(np.empty((0, 3)), None, {"intensity": np.empty(0, np.uint16)}), path)
    stream = open_stream(path)
    assert stream.points == 0 and [len(piece) for piece in stream.pieces(PIECE)] == [0]
