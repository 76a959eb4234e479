from __future__ import annotations

import io

import numpy as np
import pytest

from jetnormal.rendering.png import encode_png


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (40, 60)])
def test_another_reader_sees_the_same_pixels(shape):
    image = pytest.importorskip("matplotlib.image")
    pixels = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    back = image.imread(io.BytesIO(encode_png(pixels)), format="png")
    assert np.array_equal(np.round(back * 255).astype(np.uint8), pixels)


def test_plain_areas_take_little_room():
    assert len(encode_png(np.full((500, 500, 3), 255, dtype=np.uint8))) < 5000
