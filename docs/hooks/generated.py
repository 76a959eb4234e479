"""Fill tables of options and help texts into the pages, from the code that defines them.

`<!-- options: EstimateOptions -->` becomes a table of the fields of that class of `jetnormal.jobs.options`,
`<!-- help: estimate -->` the help of that command.
"""

from __future__ import annotations

import re
import subprocess
import sys
from typing import Any

from jetnormal.jobs import options
from jetnormal.support.options import Option, fields


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace the comments of a page."""
    markdown = re.sub(r"<!-- options: (\w+) -->", lambda match: options_table(match[1]), markdown)
    return re.sub(r"<!-- help: (\w+) -->", lambda match: command_help(match[1]), markdown)


def options_table(name: str) -> str:
    """A Markdown table of the options of a class."""
    rows = ["| option | default | |", "|---|---|---|"]
    for field in fields(getattr(options, name)):
        if isinstance(field.note, Option):
            default = field.note.default or f"`{field.default!r}`"
            rows.append(f"| `{field.name}` | {default} | {field.note.help} |".replace("NAME|FILE", "NAME or FILE"))
    return "\n".join(rows)


def command_help(command: str) -> str:
    """The help of a command, as a terminal shows it."""
    program = [sys.executable, "-m", "jetnormal", command, "--help"]
    text = subprocess.run(program, check=True, capture_output=True, text=True).stdout
    return f"```text\n{text}```"
