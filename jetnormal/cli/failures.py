"""From exceptions to exit codes: the only place where the program decides how it ends."""

from __future__ import annotations

import logging
import re
import sys
import traceback
from contextlib import suppress

from jetnormal.errors import JetnormalError, ResourceError
from jetnormal.support.report import logger, print_json

FLAGS = {"overwrite": "--force"}  # that are called otherwise than the option of the library


def spell(message: str) -> str:
    """Turn the options in a message, which the library writes as `name` or `name=value`, into flags."""

    def flag(match: re.Match[str]) -> str:
        name, value = match.groups()
        flag = FLAGS.get(name, f"--{name.replace('_', '-')}")
        return f"{flag} {value}" if value else flag

    return re.sub(r"`([a-z]\w*)(?:=([^`]*))?`", flag, message)


def report_failure(error: Exception) -> int:
    """Say in one line on stderr what went wrong, after the traceback under `-v`; return the exit code.

    Under `--json`, the same is said on stdout as {"error": ..., "code": ...}.
    """
    verbose = logger.isEnabledFor(logging.DEBUG)
    if hasattr(error, "format_message"):  # a command line that Typer does not understand, which it explains itself
        error.show()  # type: ignore[attr-defined]
        message, code = error.format_message(), error.exit_code  # type: ignore[attr-defined]
        report_json(message, code)
        return int(code)
    if verbose:
        traceback.print_exception(error)
    if isinstance(error, JetnormalError):
        message, code = str(error), error.exit_code
    elif isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":  # PyTorch's, on a GPU
        message, code = "out of memory: try a smaller `batch_size` or fewer points", ResourceError.exit_code
    else:
        hint = "" if verbose else " (run again with -v for the traceback)"
        message, code = f"{type(error).__name__}: {error}{hint}", JetnormalError.exit_code
    message = spell(" ".join(message.split()))
    with suppress(OSError):  # behind stderr may be a full disk; the exit code still tells
        sys.stderr.write(f"jetnormal: error: {message}\n")
    report_json(message, code)
    return code


def report_json(message: str, code: int) -> None:
    """Say on stdout, under `--json`, that and why the program failed."""
    if "--json" in sys.argv[1:]:
        with suppress(OSError):
            print_json({"error": message, "code": code})
