"""Arrays from .npz files that anyone may have written or damaged."""

from __future__ import annotations

import math
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jetnormal.errors import InputError, ResourceError


def load_arrays(path: Path, *names: str) -> list[NDArray[Any]]:
    """Read arrays by their names; nothing is unpickled.

    Raises:
        InputError: the file is missing, damaged, or lacks an array.
        ResourceError: it does not fit into memory.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = archive.namelist()
            missing = [name for name in names if f"{name}.npy" not in members]
            if not missing:
                return [_load(archive, f"{name}.npy") for name in names]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except MemoryError as error:
        raise ResourceError(f"{path}: does not fit into memory; use a smaller file") from error
    except Exception as error:  # NumPy's and zipfile's parsers raise errors of a dozen kinds on damaged files
        raise InputError(f"{path}: not a readable .npz file ({type(error).__name__}: {str(error)[:200]})") from error
    raise InputError(f"{path}: lacks the array {missing[0]!r}")


def _load(archive: zipfile.ZipFile, member: str) -> NDArray[Any]:
    with archive.open(member) as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a header is of an old form
        version = np.lib.format.read_magic(stream)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, _, dtype = read_header[version](stream)
        if math.prod(shape) * dtype.itemsize > archive.getinfo(member).file_size:
            raise ValueError(f"{member} declares a shape of {shape}, but is too short for it")
    with archive.open(member) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)
