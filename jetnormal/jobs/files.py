"""Read and write the files of clouds with the options of the user."""

from __future__ import annotations

from pathlib import Path

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.errors import UsageError
from jetnormal.jobs.options import FileOptions, ReadOptions


def read_file(source: Path, files: ReadOptions) -> Cloud:
    """Read a cloud.

    Raises:
        InputError, UsageError, ResourceError: as `formats.read`.
    """
    format = formats.format_for(source, files.format)
    return formats.read(source, format=format, columns=files.columns, decimal=files.decimal)


def check_file(target: Path, files: FileOptions, *, overwrite: bool) -> None:
    """Check before the long work that a file can be written.

    Raises:
        InputError, UsageError: it cannot.
    """
    format = formats.format_for(target, files.format)
    formats.check_target(target, format=format, encoding=files.encoding, overwrite=overwrite)


def write_file(cloud: Cloud, target: Path, files: FileOptions, *, overwrite: bool) -> list[str]:
    """Write a cloud; return what could not be kept.

    Raises:
        InputError, UsageError: as `formats.write`.
    """
    format = formats.format_for(target, files.format)
    return formats.write(cloud, target, format=format, encoding=files.encoding, overwrite=overwrite)


def check_format(files: ReadOptions, *paths: Path) -> None:
    """Refuse the option `format` if the suffixes of all files tell their formats.

    Raises:
        UsageError: every path has a suffix that tells its format.
    """
    if files.format is not None and not any(formats.format_for(path, files.format) for path in paths):
        known = " and ".join(map(str, paths))
        raise UsageError(f"`format` is for files whose suffix does not tell it: {known}; leave it out")
