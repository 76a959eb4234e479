"""Take pages into the site that have their place elsewhere in the repository: model cards, CONTRIBUTING, CHANGELOG.

Pages in `docs` link to them as `../models/cloudfit.md`, which a forge and an editor follow.
The site has no folder above.
"""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

PATTERNS = ("CHANGELOG.md", "CONTRIBUTING.md", "models/[!R]*.md", "models/*.png", "samples/*.png")


def on_page_markdown(markdown: str, **_: object) -> str:
    """Turn links out of `docs` into links within the site."""
    return markdown.replace("](../", "](")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the files at the same path as in the repository."""
    root = Path(config.config_file_path).parent
    for pattern in PATTERNS:
        for path in sorted(root.glob(pattern)):
            name = path.relative_to(root).as_posix()
            files.append(File(name, str(root), config.site_dir, config.use_directory_urls))
    return files
