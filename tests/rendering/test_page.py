"""The page's numbers and its size; test_browser.py looks at it in a browser."""

from __future__ import annotations

import base64
import json
import re

import numpy as np
import pytest
from shapes import sphere

from jetnormal import Cloud
from jetnormal.rendering.page import encode_octahedral, encode_page
from jetnormal.rendering.scene import cloud_scene
from jetnormal.support.open3d_loader import import_open3d


def ball(count: int) -> Cloud:
    return Cloud(5 * sphere(count), sphere(count))


def content(page: bytes) -> tuple[dict, bytes]:
    text = page.decode()
    meta = re.search(r'<script id="meta"[^>]*>(.*?)</script>', text, re.S)
    data = re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.S)
    return json.loads(meta[1]), base64.b64decode(data[1])


def test_octahedral_normals_are_right_to_a_degree():
    normals = np.r_[ball(5000).normals, np.eye(3), -np.eye(3)]
    flat = encode_octahedral(normals).astype(float) / 127
    z = 1 - np.abs(flat).sum(axis=1)
    folded = (1 - np.abs(flat[:, ::-1])) * np.where(flat < 0, -1, 1)
    back = np.c_[np.where(z[:, None] < 0, folded, flat), z]
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.clip((back * normals).sum(axis=1), -1, 1))).max() < 1


def test_the_page_holds_the_points():
    cloud = ball(100)
    meta, data = content(encode_page(cloud_scene(cloud), "a & <b>", "iso", "white"))
    places = np.frombuffer(data, "<i2", 300).reshape(100, 3) / 32767
    assert meta["vertices"] == 100 and meta["faces"] == 0 and meta["normals"]
    radius = np.linalg.norm(cloud_scene(cloud).points, axis=1).max()
    assert np.abs(places * radius - cloud_scene(cloud).points).max() < 1e-3
    assert len(data) == 12 * 100
    assert meta["colorings"] == ["normals", "plain"] and meta["coloring"] == "normals"


def test_up_turns_the_view_and_not_the_normals_that_the_page_colors_by():
    upright = cloud_scene(ball(100))
    turned = upright.turned_up(np.array([1.0, 2.0, -3.0]))
    (plain, places), (meta, data) = (content(encode_page(one, "cloud", "front", "white")) for one in (upright, turned))
    assert np.abs(np.frombuffer(data, "i1", 200, 600) - np.frombuffer(places, "i1", 200, 600).astype(int)).max() <= 1
    axes = np.reshape(meta["turn"], (3, 3))
    assert np.allclose(upright.points @ axes.T, turned.points @ np.reshape(plain["turn"], (3, 3)).T)


def test_the_page_holds_the_file_s_colors_and_its_confidence_whatever_is_shown_first():
    cloud = sphere(50)
    colors = dict(zip(("red", "green", "blue"), np.tile(np.uint8([[10], [20], [30]]), 50), strict=True))
    confidence = np.linspace(0, 1, 50).astype(np.float32)
    scene = cloud_scene(Cloud(cloud, cloud, colors | {"confidence": confidence}), "plain")
    meta, data = content(encode_page(scene, "cloud", "iso", "white"))
    assert meta["colorings"] == ["normals", "file", "confidence", "plain"] and meta["coloring"] == "plain"
    assert np.array_equal(np.frombuffer(data, "u1", 150, 8 * 50).reshape(50, 3)[7], [10, 20, 30])
    assert np.array_equal(np.frombuffer(data, "u1", 50, 11 * 50), np.round(confidence * 255))


def test_the_page_has_the_lamps_of_the_pictures():
    page = encode_page(cloud_scene(Cloud(sphere(10))), "cloud", "iso", "white").decode()
    assert "lamp = normalize(vec3(-0.450, 0.600, 0.660))" in page and "{{" not in page


def test_names_cannot_break_the_page():
    page = encode_page(cloud_scene(ball(10)), "</script><script>alert(1)</script>", "iso", "dark").decode()
    assert "alert(1)</script>" not in page and "&lt;/script&gt;" in page


def test_a_hundred_thousand_points_take_less_than_five_megabytes():
    assert len(encode_page(cloud_scene(ball(100_000)), "cloud", "auto", "white")) < 5e6


def test_large_clouds_and_meshes_are_thinned():
    from jetnormal import Mesh
    from jetnormal.rendering.scene import mesh_scene

    meta, _ = content(encode_page(cloud_scene(ball(2000)), "cloud", "auto", "white", max_points=500))
    assert meta["vertices"] == 500 and meta["shown"] == "2,000 points, 500 points shown"
    if import_open3d() is None:
        pytest.skip("there is no Open3D to simplify meshes")
    axis = np.linspace(0, 1, 21)
    vertices = np.stack([*np.meshgrid(axis, axis), np.zeros((21, 21))], axis=-1).reshape(-1, 3)
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).reshape(-1, 1)
    faces = np.concatenate([np.add(corner, [0, 1, 21]), np.add(corner, [1, 22, 21])])
    meta, data = content(encode_page(mesh_scene(Mesh(vertices, faces)), "mesh", "auto", "white", max_faces=200))
    assert 100 < meta["faces"] <= 200
    assert len(data) == 12 * meta["vertices"] + 12 * meta["faces"]
