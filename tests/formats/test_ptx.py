"""PTX: grids of points below the poses of their scanners."""

from __future__ import annotations

import numpy as np
import pytest

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.errors import InputError

HEADER = "2\n3\n10 20 30\n0 1 0\n-1 0 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n10 20 30 1\n"
GRID = "1 0 0 0.5\n0 0 0 0.5\n2 0 0 0.25\n0 0 0 0.5\n0 3 0 0.75\n0 0 4 1\n"


def test_scans_come_into_the_common_frame(tmp_path):
    identity = "1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "a.ptx").write_text(HEADER + GRID + identity + "7 8 9 0\n")
    cloud = formats.read(tmp_path / "a.ptx")
    assert cloud.points.tolist() == [[10, 21, 30], [10, 22, 30], [7, 20, 30], [10, 20, 34], [7, 8, 9]]
    assert cloud.source.sensors.tolist() == [[10, 20, 30]] * 4 + [[0, 0, 0]]
    assert cloud.source.notes == ("2 points that were not measured are left out",)
    assert cloud.attributes["scan"].tolist() == [0, 0, 0, 0, 1]
    assert cloud.attributes["row"].tolist() == [0, 2, 1, 2, 0]
    assert cloud.attributes["column"].tolist() == [0, 0, 1, 1, 0]
    assert cloud.attributes["intensity"].tolist() == [0.5, 0.25, 0.75, 1, 0]


def test_colors_and_scans_without_them(tmp_path):
    colored = "\n".join(f"{line} {number} 0 255" for number, line in enumerate(GRID.splitlines())) + "\n"
    (tmp_path / "a.ptx").write_text(HEADER + colored + HEADER + GRID)
    cloud = formats.read(tmp_path / "a.ptx")
    assert cloud.attributes["red"].tolist() == [0, 2, 4, 5, 0, 0, 0, 0] and cloud.attributes["red"].dtype == np.uint8
    assert any("1 of 2 scans have no 'red'" in note for note in cloud.source.notes)


def test_without_a_position_the_origin_may_be_one(tmp_path):
    identity = "1\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "a.ptx").write_text(identity + "7 8 9 0\n")
    source = formats.read(tmp_path / "a.ptx").source
    assert source.sensors is None and source.viewpoint == (0, 0, 0, 1, 0, 0, 0)


def test_there_is_no_place_for_normals(tmp_path):
    for action in (formats.check_target, lambda path: formats.write(Cloud(np.zeros((1, 3))), path)):
        with pytest.raises(InputError, match=r"cannot hold normals; write \.ply"):
            action(tmp_path / "a.ptx")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "2\n3\n",
        "1 2 3\n4 5 6\n",
        HEADER,
        HEADER + GRID[:30],
        HEADER + GRID.replace("3", "x"),
        HEADER + GRID.replace("\n", " 1\n"),
        HEADER.replace("0 1 0 0", "0 2 0 0") + GRID,
        HEADER.replace("2\n3\n", "200000\n300000\n") + GRID,
        HEADER.replace("2\n3\n", "-2\n3\n") + GRID,
    ],
)
def test_damaged_files_are_named(tmp_path, text):
    (tmp_path / "bad.ptx").write_text(text)
    with pytest.raises(InputError, match=r"bad\.ptx: "):
        formats.read(tmp_path / "bad.ptx")


@pytest.mark.parametrize("turned", [False, True])
def test_a_raster_around_the_origin_shows_that_the_scanner_stood_there(tmp_path, turned):
    """A full turn in 40 columns of 15 rows; the same points in another order are no raster."""
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, 40, endpoint=False) + 0.3, np.linspace(-1, 1, 15), indexing="ij"
    )
    distance = np.random.default_rng(0).uniform(2, 9, azimuth.shape)
    level = distance * np.cos(elevation)
    points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=-1)
    rows = points.reshape(-1, 3)
    rows = np.random.default_rng(1).permutation(rows) if turned else rows
    text = "40\n15\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    text += "".join(f"{x:.4f} {y:.4f} {z:.4f} 0.5\n" for x, y, z in rows)
    (tmp_path / "a.ptx").write_text(text)
    source = formats.read(tmp_path / "a.ptx").source
    if turned:
        assert source.sensors is None and source.viewpoint[:3] == (0, 0, 0)
    else:
        assert source.sensors.shape == (600, 3) and not source.sensors.any()
