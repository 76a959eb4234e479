"""PNG files: https://www.w3.org/TR/png-3/"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray


def encode_png(image: NDArray[Any]) -> bytes:
    """Encode an image (H, W, 3) uint8 as the bytes of a PNG file."""
    height, width, _ = image.shape
    # Each row as its difference from the row above, which compresses well.
    above = np.concatenate([np.zeros_like(image[:1]), image[:-1]])
    rows = np.full((height, 1 + 3 * width), 2, dtype=np.uint8)  # filter type 2, "up"
    rows[:, 1:] = (image - above).reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)  # 8 bits, RGB
    parts = (b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*part) for part in parts)


def _chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
