"""From exceptions to exit codes: the only place where the program decides how it ends."""

from __future__ import annotations

import logging
import sys
import traceback
from contextlib import suppress

from jetnormal.errors import JetnormalError, ResourceError
from jetnormal.support.report import logger


def report_failure(error: Exception) -> int:
    """Say in one line on stderr what went wrong, after the traceback under `-v`; return the exit code."""
    verbose = logger.isEnabledFor(logging.DEBUG)
    if verbose:
        traceback.print_exception(error)
    if isinstance(error, JetnormalError):
        message, code = str(error), error.exit_code
    elif isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":  # PyTorch's, on a GPU
        message, code = "out of memory: try a smaller --batch-size or fewer points", ResourceError.exit_code
    else:
        hint = "" if verbose else " (run again with -v for the traceback)"
        message, code = f"{type(error).__name__}: {error}{hint}", JetnormalError.exit_code
    with suppress(OSError):  # behind stderr may be a full disk; the exit code still tells
        sys.stderr.write(f"jetnormal: error: {' '.join(message.split())}\n")
    return code
