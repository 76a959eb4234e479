"""The entry point of the program `jetnormal`, and of `python -m jetnormal`."""

import sys
from typing import NoReturn

INTERRUPTED = 130  # as in `errors`; imports are what may be interrupted here


def program() -> NoReturn:
    """Run the command line; Ctrl-C while it is being imported ends it without a traceback, too."""
    try:
        from jetnormal.cli.app import program as run
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    run()


if __name__ == "__main__":
    program()
