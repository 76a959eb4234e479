"""From what a camera sees to a picture: light, soft shadows in corners, and a background."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.rendering.camera import Camera
from jetnormal.rendering.surfels import Surfels

Image = NDArray[np.floating[Any]]

BACKGROUNDS = {"white": (1.0, 1.0, 1.0), "dark": (0.09, 0.10, 0.12)}
KEY = np.array([-0.45, 0.60, 0.66])  # towards a large lamp at the upper left of the camera
FILL = np.array([0.80, 0.10, 0.59])
BACK_TINT = np.array([0.62, 0.55, 0.52])  # of the inner side of a surface
OCCLUSION_RADIUS = 0.12  # of the object's size
OCCLUSION_SAMPLES = 28
OCCLUSION_STRENGTH = 1.1


def develop(surfels: Surfels, camera: Camera, radius: float, supersampling: int, background: str) -> NDArray[np.uint8]:
    """Make a picture (H, W, 3) uint8 of what a camera sees.

    Args:
        surfels: what is seen; height and width are multiples of the supersampling.
        camera: that saw it.
        radius: half the size of the scene.
        supersampling: pixels of `surfels` along the side of one pixel of the picture.
        background: "white" or "dark".
    """
    hit = np.isfinite(surfels.depth)
    rays = camera.rays().astype(np.float32)
    places = rays * np.where(hit, surfels.depth, 0).astype(np.float32)[..., None]  # seen from the camera
    normals = np.where(surfels.normals.any(axis=2, keepdims=True), surfels.normals, _normals_of(places, hit))
    normals = np.where(surfels.back[..., None], -normals, normals)
    small = (slice(None, None, supersampling),) * 2  # soft shadows do not need each pixel
    shadow = _occlusion(places[small], normals[small], hit[small], camera.scale / supersampling, radius)
    shadow = np.repeat(np.repeat(shadow, supersampling, 0), supersampling, 1)[: hit.shape[0], : hit.shape[1]]
    colors = np.where(surfels.back[..., None], surfels.colors * BACK_TINT, surfels.colors)
    lit = _shade(_to_light(colors), normals, rays, shadow)
    image = np.where(hit[..., None], _to_screen(lit), np.array(BACKGROUNDS[background]))
    return _reduced(image, supersampling)


def _shade(colors: Image, normals: Image, rays: Image, shadow: Image) -> Image:
    """Amounts of light that leave surfaces of some color towards the camera."""
    key, fill = (_wrapped(normals @ (lamp / np.linalg.norm(lamp)).astype(np.float32)) for lamp in (KEY, FILL))
    sky = 0.5 + 0.5 * normals[..., 1]
    diffuse = 0.95 * key + 0.30 * fill + (0.28 + 0.16 * sky) * shadow
    half = KEY / np.linalg.norm(KEY) - rays / np.linalg.norm(rays, axis=2, keepdims=True)
    half /= np.linalg.norm(half, axis=2, keepdims=True)
    gloss = 0.07 * np.clip((normals * half).sum(axis=2), 0, 1) ** 30
    soft = 0.35 + 0.65 * shadow  # lamps are large: corners keep some of their light from them, too
    return np.asarray(colors * (diffuse * soft)[..., None] + (gloss * shadow)[..., None])


def _wrapped(cosine: Image) -> Image:
    """Light of a lamp so large that it reaches a little around the horizon."""
    return np.clip((cosine + 0.15) / 1.15, 0, 1) ** 1.3


def _occlusion(places: Image, normals: Image, hit: NDArray[np.bool_], scale: float, radius: float) -> Image:
    """How open to the sky each pixel is, 0 to 1: screen-space ambient occlusion over a spiral of samples."""
    height, width = hit.shape
    reach = OCCLUSION_RADIUS * 2 * radius
    typical_depth = float(-places[..., 2][hit].mean()) if hit.any() else 1.0
    blocked = np.zeros(hit.shape, dtype=np.float32)
    turn = np.pi * (3 - np.sqrt(5))
    for i in range(OCCLUSION_SAMPLES):
        far = scale * reach / typical_depth * ((i + 0.5) / OCCLUSION_SAMPLES) ** 0.8
        right, down = round(far * np.cos(i * turn)), round(far * np.sin(i * turn))
        here = _window(height, down), _window(width, right)
        there = _window(height, -down), _window(width, -right)
        towards = places[there] - places[here]
        squared = (towards**2).sum(axis=2) + (1e-3 * reach) ** 2
        rise = (towards * normals[here]).sum(axis=2) / np.sqrt(squared)
        near = 1 / (1 + squared / (0.25 * reach * reach))
        blocked[here] += np.clip(rise - 0.08, 0, 1) * near * hit[there]
    return np.asarray(np.clip(1 - 4 * OCCLUSION_STRENGTH * blocked / OCCLUSION_SAMPLES, 0, 1))


def _window(length: int, shift: int) -> slice:
    """The part of an axis whose places are still on it after a shift."""
    return slice(max(0, -shift), max(0, min(length, length - shift)))


def _normals_of(places: Image, hit: NDArray[np.bool_]) -> Image:
    """Normals that the places themselves suggest, for clouds without any: of their differences along both axes."""
    right, down = np.gradient(places, axis=1), np.gradient(places, axis=0)
    normals = np.cross(down, right)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    facing = np.where(length > 0, normals / np.where(length > 0, length, 1), np.array([0, 0, 1.0]))
    return np.where(hit[..., None], facing, 0).astype(np.float32)


def _reduced(image: Image, factor: int) -> NDArray[np.uint8]:
    """The mean of each block of factor x factor pixels."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    blocks = image[: height * factor, : width * factor].reshape(height, factor, width, factor, 3)
    return np.round(np.clip(blocks.mean(axis=(1, 3)), 0, 1) * 255).astype(np.uint8)


def _to_light(colors: Image) -> Image:
    return np.asarray(colors) ** 2.2


def _to_screen(light: Image) -> Image:
    """Brightness on a screen; highlights saturate softly."""
    light = np.maximum(light, 0)
    return np.asarray(np.where(light < 0.8, light, 1 - 0.2 * np.exp(-(light - 0.8) / 0.2)) ** (1 / 2.2))
