"""The names and files of the packaged models; nothing is loaded here."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from jetnormal.errors import ModelError
from jetnormal.support.suggest import did_you_mean

SUFFIX = ".safetensors"


def model_directory() -> Path:
    """Folder of the packaged models: inside an installed wheel, or at the top of a source checkout."""
    package = Path(__file__).parents[1]
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def packaged_names() -> list[str]:
    """List the names of the packaged networks."""
    return sorted(path.stem for path in model_directory().glob(f"*{SUFFIX}"))


def complete_network(text: str) -> list[str]:
    """List the packaged networks whose names begin with a text."""
    return [name for name in packaged_names() if name.startswith(text)]


def resolve(name: str | Path, others: Iterable[str] = ()) -> Path:
    """Find the file of a packaged network (`cloudfit`) or of a path.

    Args:
        name: of a network, or a path.
        others: further names that the error message lists.

    Raises:
        ModelError: it is neither.
    """
    with suppress(OSError):  # such as a name too long for a file
        packaged = model_directory() / f"{name}{SUFFIX}"
        if packaged.is_file():
            return packaged
        path = Path(name)
        if path.is_file():
            return path
        if (network := path / f"model{SUFFIX}").is_file():
            raise ModelError(f"{path}: is the folder of a run; its network is {network}")
    known = [*packaged_names(), *others]
    hint = did_you_mean(str(name), known)
    raise ModelError(f"{str(name)[:200]}: neither a packaged model ({', '.join(known)}) nor a model file{hint}")
