"""`jetnormal preview`: pictures and pages from files, and what cannot be drawn."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
from shapes import sphere
from typer.testing import CliRunner

from jetnormal import Cloud, formats
from jetnormal.cli.app import app
from jetnormal.errors import InputError, ResourceError, UsageError
from jetnormal.formats.meshes import write_mesh
from jetnormal.jobs import preview
from jetnormal.jobs.options import PreviewOptions
from jetnormal.jobs.preview import _columns, draw, in_grid, preview_file
from jetnormal.mesh import Mesh
from jetnormal.rendering.scene import cloud_scene


@pytest.fixture
def files(tmp_path):
    normals = sphere(500)
    formats.write(Cloud(np.r_[normals, [[np.nan] * 3]], np.r_[normals, [[0, 0, 1.0]]]), tmp_path / "cloud.ply")
    formats.write(Cloud(normals), tmp_path / "bare.xyz")
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    write_mesh(Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])), tmp_path / "mesh.ply")
    (tmp_path / "kept.png").write_text("precious")
    return tmp_path


def test_views_stand_side_by_side(files):
    image = pytest.importorskip("matplotlib.image")
    options = PreviewOptions(views=("iso", "front", "top"), size=60)
    summary = preview_file(files / "cloud.ply", files / "out.png", None, options)
    picture = image.imread(io.BytesIO((files / "out.png").read_bytes()), format="png")
    assert summary["points"] == 501 and summary["faces"] == 0
    assert picture.shape[1] == pytest.approx(3 * 60 + 2 * round(0.03 * 60), abs=9)
    drawn = (picture < 0.99).any(axis=2).mean(axis=0)
    assert all(drawn[column] > 0.5 for column in (30, 92, 152))


def test_colorings_stand_side_by_side(files):
    image = pytest.importorskip("matplotlib.image")
    options = PreviewOptions(views=("iso",), size=60, colors=("plain", "normals"))
    preview_file(files / "cloud.ply", files / "out.png", None, options)
    picture = image.imread(io.BytesIO((files / "out.png").read_bytes()), format="png")[..., :3]
    spread = np.ptp(picture, axis=2)
    assert spread[:, :55].max() < 0.2 < spread[:, 70:].max()


@pytest.mark.parametrize(
    ("scenes", "views", "rows", "columns"), [(1, 2, 1, 2), (3, 1, 1, 3), (1, 4, 2, 2), (1, 5, 2, 3), (2, 3, 2, 3)]
)
def test_many_views_stand_in_a_grid(scenes, views, rows, columns):
    images = [np.full((10, 20, 3), 50 + number, np.uint8) for number in range(scenes * views)]
    picture = in_grid(images, _columns(scenes, views), np.full(3, 255, np.uint8), 4)
    assert picture.shape == (10 * rows + 4 * (rows - 1), 20 * columns + 4 * (columns - 1), 3)
    for number in range(len(images)):
        row, column = divmod(number, columns)
        assert (picture[14 * row : 14 * row + 10, 24 * column : 24 * column + 20] == 50 + number).all()


def test_smaller_pictures_stand_in_the_middle_of_their_cells():
    picture = in_grid([np.zeros((4, 8, 3), np.uint8), np.zeros((8, 4, 3), np.uint8)], 1, np.full(3, 255, np.uint8), 2)
    assert picture.shape == (14, 8, 3)
    assert (picture[6:14, 2:6] == 0).all() and (picture[6:14, :2] == 255).all() and (picture[4:6] == 255).all()


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, -2), (1, 2, 3)])
def test_up_is_brought_to_z_and_nothing_is_deformed(up):
    normals = np.random.default_rng(0).normal(size=(50, 3))
    cloud = Cloud(np.r_[[[0.0, 0, 0], up], normals], np.r_[[[0.0, 0, 1]] * 2, normals])
    scene = cloud_scene(cloud)
    turned = scene.turned_up(np.array(up, dtype=float))
    offset = turned.points[1] - turned.points[0]
    np.testing.assert_allclose(offset, [0, 0, np.linalg.norm(up)], atol=1e-12)
    np.testing.assert_allclose(turned.points @ turned.normals.T, scene.points @ scene.normals.T, atol=1e-12)
    np.testing.assert_array_equal(turned.colors, scene.colors)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("size", [1e-300, 1e140, 1e300])
def test_the_size_of_a_cloud_does_not_matter(size):
    points = np.random.default_rng(0).normal(size=(300, 3))
    options = PreviewOptions(size=40, views=("iso",))
    seen, same = (draw([cloud_scene(Cloud(scale * points))], options) for scale in (1.0, size))
    assert np.abs(seen.astype(int) - same).max() <= 2 and seen.min() < 200


@pytest.mark.parametrize("length", [1e308, 1e-320])
def test_up_may_have_any_length(length):
    scene = cloud_scene(Cloud(np.eye(3)))
    turned = scene.turned_up(np.array([0.0, length, length]))
    np.testing.assert_allclose(turned.points, scene.turned_up(np.array([0.0, 1.0, 1.0])).points, atol=1e-3)


def test_a_ply_file_with_faces_is_drawn_as_a_mesh(files):
    summary = preview_file(files / "mesh.ply", files / "out.png", files / "out.html", PreviewOptions(size=40))
    assert summary["faces"] == 4
    assert b'"faces": 4' in (files / "out.html").read_bytes()


@pytest.mark.parametrize(
    ("source", "picture", "options", "words"),
    [
        ("missing.ply", "out.png", {}, "missing.ply"),
        ("cloud.ply", "kept.png", {}, "`overwrite`"),
        ("cloud.ply", "out.jpg", {}, ".png"),
        ("cloud.ply", "nowhere/out.png", {}, "nowhere"),
        ("kept.png", "out.png", {}, "suffix"),
        ("bare.xyz", "out.png", {"colors": ("normals",)}, "jetnormal estimate"),
        ("bare.xyz", "out.png", {"colors": ("plain", "file")}, "no colors"),
    ],
)
def test_what_cannot_be_drawn_is_an_input_error(files, source, picture, options, words):
    before = sorted(files.iterdir())
    with pytest.raises(InputError, match=words.replace("(", "")):
        preview_file(files / source, files / picture, None, PreviewOptions(size=40, **options))
    assert sorted(files.iterdir()) == before and (files / "kept.png").read_text() == "precious"


@pytest.mark.parametrize(
    "options", [{"views": ()}, {"views": ("nowhere",)}, {"views": ("nan:0",)},
                {"size": 3}, {"colors": ("rainbow",)}, {"colors": ()},
                {"background": "pink"}, {"up": (0, 0, 0)}, {"up": (0, np.nan, 1)}]
)  # fmt: skip
def test_options_out_of_range_are_usage_errors(options):
    with pytest.raises(UsageError):
        PreviewOptions(**options)


def test_the_command_line_writes_both(files):
    arguments = ["preview", files / "cloud.ply", "-o", files / "a.png", "--html", files / "a.html", "--json"]
    result = CliRunner().invoke(app, [*map(str, arguments), "--views", "front,30:20", "--size", "50", "--up", "0,1,0"])
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["picture"].endswith("a.png") and summary["page"].endswith("a.html")
    assert (files / "a.png").read_bytes().startswith(b"\x89PNG") and (files / "a.html").stat().st_size > 5000


def test_a_picture_larger_than_memory_is_refused(files, monkeypatch):
    monkeypatch.setattr(preview, "machine_memory", lambda: 8 << 30)
    with pytest.raises(ResourceError, match=r"`size=8192` would take up to \d+ GB"):
        preview_file(files / "cloud.ply", files / "out.png", None, PreviewOptions(size=8192, views=("front", "back")))
    assert not (files / "out.png").exists()


def test_a_target_is_needed(files):
    with pytest.raises(UsageError, match="`html`"):
        preview_file(files / "cloud.ply", None, None, PreviewOptions())
