"""From exceptions to exit codes: the only place where the program decides how it ends."""

from __future__ import annotations

import logging
import os
import re
import sys
import traceback
from contextlib import suppress

from jetnormal.errors import INTERRUPTED, InputError, JetnormalError, ResourceError, is_out_of_memory
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
    if isinstance(error, BrokenPipeError):  # nobody reads on, as behind `| head`
        _silence_stdout()
        return JetnormalError.exit_code
    if verbose:
        traceback.print_exception(error)
    if isinstance(error, JetnormalError):
        message, code = str(error), error.exit_code
    elif is_out_of_memory(error):
        message, code = "out of memory: try a smaller `batch_size` or fewer points", ResourceError.exit_code
    elif _was_interrupted(error):
        report_json("interrupted", INTERRUPTED)
        return INTERRUPTED
    elif isinstance(error, OSError) and error.filename is None:  # no file of ours, which raise errors of their own
        _silence_stdout()
        message = f"the output cannot be written ({error.strerror or error}); free some space or choose another output"
        code = InputError.exit_code
    else:
        found = f"{type(error).__name__}: {str(error)[:500]}"
        hint = "the traceback above" if verbose else "the traceback that -v prints"
        message = f"{found}; this should not happen: please report it, with the command and {hint}"
        code = JetnormalError.exit_code
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


def _was_interrupted(error: BaseException | None) -> bool:
    """Whether a Ctrl-C came first: Python's locks raise errors of their own where it interrupts them."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _silence_stdout() -> None:
    """Send what is left in the buffer of stdout nowhere: Python would fail on it once more at its end."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
