"""The entry point of the program `jetnormal`, and of `python -m jetnormal`."""

import sys
from typing import NoReturn


def program() -> NoReturn:
    """Run the command line; Ctrl-C while it is being imported ends it without a traceback, too."""
    try:
        from jetnormal.cli.app import program as run
    except KeyboardInterrupt:
        from jetnormal.errors import INTERRUPTED

        sys.exit(INTERRUPTED)
    run()


if __name__ == "__main__":
    program()
