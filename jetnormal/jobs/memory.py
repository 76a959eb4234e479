"""Estimates of what a run needs: memory of a cloud that is computed at once, points of a tile, bytes on the disk."""

from __future__ import annotations

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from jetnormal import formats
from jetnormal.errors import InputError, ResourceError
from jetnormal.estimators.blocks import bytes_of, bytes_together, core_that_fits
from jetnormal.formats import CloudStream
from jetnormal.jobs.options import LargeOptions, ReadOptions
from jetnormal.orientation.auto import ENOUGH
from jetnormal.support.report import logger

SHARE = 0.6  # of the machine's memory
PROGRAM = 500_000_000  # bytes: libraries, a model, buffers of pieces
PER_POINT = 550  # bytes of a cloud whose signs are chosen together
WHOLE_CLOUD_METHODS = ("global", "mst")  # choose all signs together; "auto" does so for up to `ENOUGH` points
HELD = 350  # bytes of any other point of a cloud in memory, most of them where each has a viewpoint of its own
THINNED = 4_000_000  # points of the thinned cloud, at most
LEAST_TILE = 20_000  # points
BINARY = 16  # bytes of a point in a file that is not text: three float32 and some more
COMPRESSED = ("las", "numpy")  # perhaps: the size of such files tells little
ON_DISK = 65  # bytes of a point in its tile, with what is found of it
OF_THINNED = 56  # bytes of a point of the thinned cloud
SENSOR = 24  # bytes of the position from which a point was seen
NEW = 12  # bytes of a point that the output has more than the input, at least


def machine_memory() -> int:
    """Bytes of memory that this machine, or the container that the process is in, has."""
    limits = []
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        if sys.platform == "linux" and (text := _text(Path(name))).isdigit():
            limits.append(int(text))
    return min(limits, default=8 << 30)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def at_once(path: Path, files: ReadOptions, limit: int, orient: str = "auto") -> int:
    """Estimate the memory in bytes that a cloud takes if it is computed at once, without reading it.

    The size of the file decides. The header is read only if it is quickly read, and the file is compressed or its size
    is beyond the limit.
    """
    known = formats.find_format(path, formats.format_for(path, files.format))
    try:
        lines = _bytes_of_a_line(path)
        rough = peak(path.stat().st_size // max(BINARY, lines), orient)
        if known.stream is None or known.stream_reads_all or lines > 0:
            return rough
        if known.name not in COMPRESSED and rough <= limit:
            return rough
    except OSError:
        return 0  # reading it tells what is wrong
    try:
        stream = known.stream(path)
    except (OSError, InputError):  # damaged, or not read in pieces
        return rough
    return peak(stream.points, orient) + 2 * stream.points * stream.bytes_per_point


def peak(points: int, orient: str = "auto") -> int:
    """Bytes that a cloud of so many points takes: of the directions or the signs, whatever is more."""
    signs = points if orient in WHOLE_CLOUD_METHODS else min(points, ENOUGH)
    return PROGRAM + max(points * HELD + bytes_together(points), signs * PER_POINT + (points - signs) * HELD)


def _bytes_of_a_line(path: Path) -> int:
    """Bytes of a row of a text file, estimated from some of its lines; 0 for other files."""
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    lines = head.count(b"\n")
    return 0 if b"\0" in head or not lines else len(head) // lines


@dataclass(frozen=True)
class Room:
    """How many points fit into memory.

    Attributes:
        tile: points of a tile, about.
        thinned: points of the thinned cloud that tells the signs, about.
    """

    tile: int
    thinned: int


def room_for_tiles(source: Path, files: ReadOptions, large: LargeOptions, orient: str = "auto") -> Room | None:
    """Find how many points fit into memory; None if the cloud is computed at once.

    Raises:
        InputError: the cloud takes more memory than it may, and its format is not read in pieces.
        ResourceError: the memory is too little for any tile.
    """
    limit = large.max_memory or round(SHARE * machine_memory())
    needed = at_once(source, files, limit, orient)
    if needed <= limit and not large.resume and large.cluster is None:
        return None
    known = formats.find_format(source, formats.format_for(source, files.format))
    if needed > limit:
        takes = f"{source}: would take {needed / 1e9:.2g} GB of memory, more than {limit / 1e9:.2g} GB (`max_memory`)"
        if known.stream is None:
            able = " ".join(sorted(s for each in formats.all_formats() if each.stream for s in each.suffixes))
            raise InputError(f"{takes}, and {known.name} files are not read in pieces; {able} are")
        logger.info("%s: it is computed in tiles", takes)
    rest = limit - PROGRAM
    room = Room(core_that_fits(rest), min(THINNED, int(rest / PER_POINT)))
    if room.tile < LEAST_TILE:
        least = (PROGRAM + bytes_of(LEAST_TILE)) / 1e9
        raise ResourceError(f"`max_memory` is {limit / 1e9:.2g} GB, but a tile needs {least:.1f} GB")
    return room


def check_disk(folder: Path, stream: CloudStream, source: Path, *, each_has_sensor: bool) -> None:
    """Check before the work that the tiles and the output fit on the disk.

    Args:
        folder: where both go.
        stream, source: the input.
        each_has_sensor: whether a tile holds the position from which each of its points was seen.

    Raises:
        InputError: they do not.
    """
    points = stream.points
    needed = points * (ON_DISK + NEW + SENSOR * each_has_sensor) + min(points, THINNED) * OF_THINNED
    needed += source.stat().st_size
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"{folder}: the tiles and the output need {needed / 1e9:.3g} GB, but {free / 1e9:.3g} GB are free; free "
            "some space or choose another output"
        )
