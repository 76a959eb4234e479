"""Where the files that ship with jetnormal lie."""

from __future__ import annotations

from pathlib import Path


def model_directory() -> Path:
    """Folder of the packaged models: inside an installed wheel, or at the top of a source checkout."""
    package = Path(__file__).parents[1]
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"
