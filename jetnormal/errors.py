"""The errors a user can meet, each with the exit code of the command line.

The library raises them; only the command line turns them into a message and an exit code. A message is one
line that says what is wrong, in which file, and what to do about it.
"""

from __future__ import annotations

import errno

_OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "can't start new thread", "bad_alloc")
INTERRUPTED = 130
"""Exit code after Ctrl-C: 128 + SIGINT, as shells count it."""


class JetnormalError(Exception):
    """The parent of all expected errors."""

    exit_code = 1


class UsageError(JetnormalError):
    """Options that contradict each other or are out of range."""

    exit_code = 2


class InputError(JetnormalError):
    """A file or a cloud that cannot be used, or a target that cannot be written."""

    exit_code = 3


class ShapeError(InputError, ValueError):
    """An array whose shape does not fit."""


class ModelError(JetnormalError):
    """An unknown, damaged or unsuitable model."""

    exit_code = 4


class ResourceError(JetnormalError):
    """Too little memory, or a device or a library that is not there."""

    exit_code = 5


class JetnormalWarning(UserWarning):
    """What a user of the library should know about a result; `warnings.filterwarnings` silences it by this class."""


def unreadable(path: object, error: OSError) -> InputError:
    """Return the error of a file that the system does not let be read."""
    return InputError(f"{path}: cannot be read ({error.strerror or error}); check the path")


def is_out_of_memory(error: BaseException) -> bool:
    """Tell whether an error of Python, the system or a library is about memory.

    PyTorch has an error of its own for a GPU, and none for a CPU.
    """
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError":
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    if isinstance(error, ImportError):  # of a compiled library, under a limit on memory
        return "failed to map segment" in str(error)
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _OUT_OF_MEMORY)
