"""The HTML page in a real browser: it draws, turns, zooms and switches colors, without an error.

Screenshots for a person to look at are left in build/screenshots.
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from shapes import even_sphere, sphere

from jetnormal import Cloud, Mesh
from jetnormal.rendering.page import encode_page
from jetnormal.rendering.scene import cloud_scene, mesh_scene

sync_api = pytest.importorskip("playwright.sync_api")
image = pytest.importorskip("matplotlib.image")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
SCREENSHOTS = Path(__file__).parents[2] / "build" / "screenshots"
# Containers have no kernel sandbox, and no GPU: SwiftShader draws.
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Viewer:
    """A page on the screen."""

    def __init__(self, page: sync_api.Page) -> None:
        self.page = page
        self.messages: list[str] = []
        page.on("console", lambda message: self.messages.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.messages.append(str(error)))

    def screenshot(self, name: str) -> np.ndarray:
        """(300, 400, 3) colors from 0 to 1, also written for a person to look at."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        content = self.page.screenshot()
        (SCREENSHOTS / f"{name}.png").write_bytes(content)
        return image.imread(io.BytesIO(content))[..., :3]

    def drag(self, x: int, y: int) -> None:
        """Drag from the middle by (x, y) pixels."""
        self.page.mouse.move(200, 150)
        self.page.mouse.down()
        self.page.mouse.move(200 + x, 150 + y, steps=3)
        self.page.mouse.up()


@pytest.fixture(scope="module")
def browser() -> Iterator[sync_api.Browser]:
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@pytest.fixture
def show(browser, tmp_path) -> Iterator[Callable[..., Viewer]]:
    """Open the page of a cloud or a mesh; at the end of the test, no message may stand in the browser's console."""
    viewers = []

    def open_page(content: Cloud | Mesh, coloring: str = "auto") -> Viewer:
        scene = (mesh_scene if isinstance(content, Mesh) else cloud_scene)(content, coloring)
        (tmp_path / "page.html").write_bytes(encode_page(scene, "cloud", "iso", "white"))
        viewer = Viewer(browser.new_page(viewport={"width": 400, "height": 300}))
        viewers.append(viewer)
        viewer.page.goto((tmp_path / "page.html").as_uri())
        return viewer

    yield open_page
    for viewer in viewers:
        viewer.page.close()
        assert viewer.messages == []


def drawn(picture: np.ndarray) -> np.ndarray:
    """(300, 400) bool: what differs from the white background, right of the panel with the name."""
    found = (picture < 0.98).any(axis=2)
    found[:, :100] = False
    return found


@pytest.fixture
def ellipsoid() -> Cloud:
    """Points on an ellipsoid with normals, and a color of their own: green."""
    normals = even_sphere(4000) / [1, 0.7, 0.3]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = dict(zip(("red", "green", "blue"), np.tile(np.uint8([[30], [220], [30]]), 4000), strict=True))
    return Cloud(even_sphere(4000) * [1, 0.7, 0.3], normals, colors)


def test_it_draws_the_cloud_before_the_background(show, ellipsoid):
    picture = show(ellipsoid).screenshot("ellipsoid")
    assert drawn(picture)[130:170, 180:220].all()
    assert np.allclose(picture[-20:, -20:], 1)
    gray = picture.mean(axis=2)
    assert gray[90:120, 180:220].mean() > gray[180:210, 180:220].mean()  # lit from above


def test_dragging_turns_it(show, ellipsoid):
    viewer = show(ellipsoid)
    before = viewer.screenshot("turn_before")
    viewer.drag(90, 60)
    after = viewer.screenshot("turn_after")
    assert (drawn(before) != drawn(after)).mean() > 0.02  # the outline is another
    assert drawn(after)[145:155, 195:205].all()


def test_the_wheel_zooms(show, ellipsoid):
    viewer = show(ellipsoid)
    before = viewer.screenshot("zoom_before")
    viewer.page.mouse.move(200, 150)
    viewer.page.mouse.wheel(0, -300)
    closer = viewer.screenshot("zoom_in")
    viewer.page.mouse.wheel(0, 900)
    farther = viewer.screenshot("zoom_out")
    assert drawn(farther).sum() < 0.9 * drawn(before).sum() < 0.9 * drawn(closer).sum()


def test_the_coloring_switches(show, ellipsoid):
    viewer = show(ellipsoid, "file")
    seen = {}
    for name in viewer.page.locator("select option").all_inner_texts():
        viewer.page.locator("select").first.select_option(name)
        seen[name] = viewer.screenshot(f"colors_{name}")
    assert len(seen) >= 3
    middles = [picture[140:160, 190:210].mean(axis=(0, 1)) for picture in seen.values()]
    for number, one in enumerate(middles):
        assert all(np.abs(one - other).max() > 0.05 for other in middles[:number])


def test_the_keys_turn_zoom_and_begin_again(show, ellipsoid):
    viewer = show(ellipsoid)
    before = viewer.screenshot("keys_before")
    for key in ("ArrowRight", "ArrowUp", "+", "+", "+"):
        viewer.page.keyboard.press(key)
    after = viewer.screenshot("keys_after")
    assert drawn(after).sum() > 1.1 * drawn(before).sum()
    viewer.page.keyboard.press("0")
    assert np.array_equal(viewer.screenshot("keys_again"), before)


def test_the_size_of_the_points_is_chosen(show, ellipsoid):
    viewer = show(ellipsoid)
    before = drawn(viewer.screenshot("size_before")).sum()
    viewer.page.locator("input[type=range]").fill("-2")
    assert drawn(viewer.screenshot("size_small")).sum() < before


def test_a_mesh_has_no_points_to_size(show):
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    viewer = show(Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), faces))
    assert drawn(viewer.screenshot("mesh")).any()
    assert viewer.page.locator("select").is_visible() and not viewer.page.locator("#size").is_visible()


def test_the_legend_explains_the_colors(show, ellipsoid):
    viewer = show(Cloud(ellipsoid.points, ellipsoid.normals, {"confidence": np.linspace(0, 1, 4000)}))
    legend = viewer.page.locator("#legend")
    assert "faces x" in legend.inner_text() and "inner side" in legend.inner_text()
    viewer.page.locator("select").select_option("confidence")
    assert "confidence 0 to 1" in legend.inner_text() and "faces x" not in legend.inner_text()
    assert "turn" in viewer.page.locator("#hint").inner_text()


def test_it_survives_a_hundred_thousand_points(show):
    points = sphere(100_000)
    viewer = show(Cloud(points, points))
    viewer.drag(60, 20)
    assert drawn(viewer.screenshot("hundred_thousand"))[100:200, 150:250].all()
