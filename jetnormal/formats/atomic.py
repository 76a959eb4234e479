"""Files and folders that appear complete or not at all."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from jetnormal.errors import InputError


def check_target(path: Path, overwrite: bool) -> None:
    """Finds out, before any long computation, whether a file can be written.

    Raises:
        InputError: if the file exists and may not be overwritten, if it is not a regular file, or if its
            folder is missing or not writable.
    """
    try:
        problem = _find_problem(path, path.resolve().parent, overwrite)
    except OSError as error:  # the name is too long, a folder on the way may not be entered
        problem = f"cannot be written ({error.strerror or error}); choose another output"
    if problem:
        raise InputError(f"{path}: {problem}")


def _find_problem(path: Path, folder: Path, overwrite: bool) -> str | None:
    if path.is_dir():
        return "is a folder; name a file in it"
    if path.exists() and not path.is_file():
        return "is not a regular file; choose another output"
    if path.exists() and not overwrite:
        return "already exists; use --force to overwrite it or choose another name"
    if not folder.is_dir():
        return f"the folder {folder} does not exist; create it first"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"the folder {folder} is not writable; choose another output"
    return None


@contextmanager
def atomic_write(path: Path, *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Opens a temporary file beside `path` that takes its name when the block ends without an exception.

    On any exception, Ctrl-C included, the temporary file is removed and `path` stays as it was. A symbolic
    link is followed, and the permissions of an overwritten file are kept.

    Raises:
        InputError: as `check_target`, and if writing fails (disk full, quota, permissions).
    """
    check_target(path, overwrite)
    target = path.resolve()
    temporary = target.with_name(f".{target.name[:100]}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as stream:
            yield stream
        if target.exists():
            shutil.copymode(target, temporary)
        temporary.replace(target)
    except OSError as error:
        advice = "free some space" if error.errno == errno.ENOSPC else "choose another output"
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); {advice}") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Makes a temporary folder beside `path` that takes its name when the block ends without an exception.

    A folder that is there already is replaced then, so that the caller must have asked for that. On any exception,
    Ctrl-C included, the temporary folder is removed and `path` stays as it was.

    Raises:
        InputError: if the folder above is missing or not writable, or if writing fails.
    """
    target = path.resolve()
    unfinished, replaced = (target.with_name(f".{target.name[:100]}.{os.getpid()}.{end}") for end in ("tmp", "old"))
    try:
        unfinished.mkdir()
        yield unfinished
        if target.exists():
            target.rename(replaced)
        try:
            unfinished.rename(target)
        except OSError:
            if replaced.exists():
                replaced.rename(target)
            raise
    except FileNotFoundError as error:
        raise InputError(f"{path}: the folder {target.parent} does not exist; create it first") from error
    except OSError as error:
        advice = "free some space" if error.errno == errno.ENOSPC else "choose another output"
        raise InputError(f"{path}: cannot be written ({error.strerror or error}); {advice}") from error
    finally:
        for leftover in (unfinished, replaced):
            shutil.rmtree(leftover, ignore_errors=True)
