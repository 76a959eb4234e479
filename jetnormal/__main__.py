"""The entry point of the program `jetnormal`, and of `python -m jetnormal`."""

import gc
import os
import sys
from pathlib import Path
from typing import NoReturn

VECTORS = {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}  # what OpenBLAS asks of a Skylake with AVX-512


def program() -> NoReturn:
    """Run the command line; Ctrl-C while it is being imported ends it without a traceback, too."""
    try:
        _use_long_vectors()
        gc.disable()  # what is imported stays; looking through it again and again takes a twentieth of the time
        from jetnormal.cli.app import program as run

        gc.enable()
    except KeyboardInterrupt:
        from jetnormal.errors import INTERRUPTED

        sys.exit(INTERRUPTED)
    run()


def _use_long_vectors(processors: Path = Path("/proc/cpuinfo")) -> None:
    """Have OpenBLAS use AVX-512 on AMD's processors: NumPy's copy takes them for a Haswell, of half the speed.

    It reads this when NumPy is imported. Who sets the variable decides otherwise.
    """
    try:
        with processors.open(encoding="ascii", errors="replace") as stream:
            first = stream.read(4096)
    except OSError:  # not Linux
        return
    if "AuthenticAMD" in first and {*first.split()} >= VECTORS:
        os.environ.setdefault("OPENBLAS_CORETYPE", "SkylakeX")


if __name__ == "__main__":
    program()
