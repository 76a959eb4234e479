"""Files and folders that appear complete or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from jetnormal.errors import InputError


def check_target(path: Path, overwrite: bool) -> None:
    """Find out, before any long computation, whether a file can be written.

    Raises:
        InputError: if the file exists and may not be overwritten, if it is not a regular file, or if its
            folder is missing or not writable.
    """
    try:
        problem = _find_problem(path, path.resolve().parent, overwrite)
    except (OSError, RuntimeError) as error:  # the name is too long, a folder on the way may not be entered, a loop
        reason = error.strerror if isinstance(error, OSError) else None
        problem = f"cannot be written ({reason or error}); choose another output"
    if problem:
        raise InputError(f"{path}: {problem}")


def _find_problem(path: Path, folder: Path, overwrite: bool) -> str | None:
    with suppress(FileNotFoundError, NotADirectoryError):
        path.stat()  # `exists` would be silent about a link that leads to itself
    if path.is_dir():
        return "is a folder; name a file in it"
    if path.exists() and not path.is_file():
        return "is not a regular file; choose another output"
    if path.exists() and not overwrite:
        return "already exists; use `overwrite` to replace it or choose another name"
    if not folder.is_dir():
        return f"the folder {folder} does not exist; create it first"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"the folder {folder} is not writable; choose another output"
    return None


@contextmanager
def atomic_write(path: Path, *, overwrite: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path` that takes its name when the block ends without an exception.

    On any exception, Ctrl-C included, the temporary file is removed and `path` stays as it was. A symbolic
    link is followed, and the permissions of an overwritten file are kept.

    Raises:
        InputError: as `check_target`, and if writing fails (disk full, quota, permissions).
    """
    check_target(path, overwrite)
    target = path.resolve()
    mode = stat.S_IMODE(target.stat().st_mode) if target.exists() else None
    temporary = _unfinished(target)
    try:
        with _create(temporary, mode) as stream:
            yield stream
        temporary.replace(target)
    except OSError as error:
        raise _writing_failed(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def _unfinished(target: Path) -> Path:
    """A name beside the target that nobody can guess: another process, machine or user may write there, too."""
    return target.with_name(f".{target.name[:100]}.{secrets.token_hex(8)}.tmp")


def _create(path: Path, mode: int | None) -> BinaryIO:
    """Create a file that has its final permissions from the start; a symbolic link is not followed."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, flags, 0o666 if mode is None else mode & 0o600)
    stream = os.fdopen(descriptor, "w+b")
    if mode is not None:
        path.chmod(mode)
    return stream


def _writing_failed(path: Path, error: OSError) -> InputError:
    advice = "free some space" if error.errno == errno.ENOSPC else "choose another output"
    return InputError(f"{path}: cannot be written ({error.strerror or error}); {advice}")


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, unless it is there.

    Raises:
        InputError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created ({error.strerror or error}); choose another folder") from error


@contextmanager
def atomic_folder(path: Path, replaceable: Collection[str] = ()) -> Iterator[Path]:
    """Make a temporary folder beside `path` that takes its name when the block ends without an exception.

    On any exception, Ctrl-C included, the temporary folder is removed and `path` stays as it was.

    Args:
        path: the folder.
        replaceable: names of the files in a folder of that name that may be removed; no others are.

    Raises:
        InputError: if the folder above is missing or not writable, if writing fails, or if the folder that is there
            holds anything else.
    """
    target = Path(os.path.realpath(path))  # which a loop of links does not stop
    unfinished = _unfinished(target)
    try:
        unfinished.mkdir()
        yield unfinished
        if target.exists():
            _replace_folder(target, unfinished, replaceable)
        else:
            unfinished.rename(target)
    except FileNotFoundError as error:
        raise InputError(f"{path}: the folder {target.parent} does not exist; create it first") from error
    except OSError as error:
        raise _writing_failed(path, error) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _replace_folder(target: Path, finished: Path, replaceable: Collection[str]) -> None:
    replaced = finished.with_suffix(".old")
    target.rename(replaced)
    try:
        strange = sorted({entry.name for entry in replaced.iterdir()} - set(replaceable))
        if strange:
            raise InputError(f"{target}: holds {strange[0]}, which is not to be replaced; choose another output")
        finished.rename(target)
    except BaseException:
        replaced.rename(target)
        raise
    for entry in replaced.iterdir():
        entry.unlink()
    replaced.rmdir()
