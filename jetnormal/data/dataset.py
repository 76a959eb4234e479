"""Sources of clouds combined: with a relief, mixed, and opened by what lies in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from jetnormal.data.options import CLOUDS_PER_EPOCH, POINTS_PER_CLOUD
from jetnormal.data.relief import add_relief
from jetnormal.data.sources import (
    TRAINING_LIST,
    DataSource,
    LabeledCloud,
    MeshFolder,
    PcpnetFolder,
    ScannedSurfaces,
    SyntheticSolids,
    meshes_in,
)
from jetnormal.errors import InputError, UsageError

NOISY = ("_medium", "_high")  # kinds of corruption whose noise is large


class WithRelief:
    """The clouds of another source, some of them with a fine relief (`data.relief`)."""

    def __init__(self, source: DataSource, share: float) -> None:
        """Take a source and the share of its clouds, between 0 and 1, that get a relief."""
        self._source = source
        self._share = share

    @property
    def clouds_per_epoch(self) -> int:
        return self._source.clouds_per_epoch

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`. Clouds with much noise are left as they are: it would drown the relief."""
        cloud = self._source.cloud(epoch, index, seed)
        rng = np.random.default_rng([seed, epoch, index, 4])
        if cloud.name.endswith(NOISY) or rng.random() >= self._share:
            return cloud
        points, normals = add_relief(cloud.points, cloud.normals, rng)
        return replace(cloud, points=points, normals=normals)


class Mixture:
    """Several sources as one: their clouds alternate in proportion to the weights.

    An epoch of the mixture is as long as those of its sources together. Each source is walked through in its
    own order, so that with a small weight its epoch spreads over several of the mixture's.
    """

    def __init__(self, sources: Sequence[DataSource], weights: Sequence[float] | None = None) -> None:
        """Plan the turns of an epoch.

        Args:
            sources: at least one.
            weights: one positive number per source; by default the sources' `clouds_per_epoch`.

        Raises:
            UsageError: there are no sources, the weights do not fit them, or one is too small for a turn.
        """
        self._sources = list(sources)
        lengths = np.array([source.clouds_per_epoch for source in sources])
        share = np.asarray(lengths if weights is None else weights, dtype=np.float64)
        if len(sources) == 0 or share.shape != lengths.shape or not (share > 0).all():
            raise UsageError("a mixture takes at least one source and one positive weight for each")
        self.clouds_per_epoch = int(lengths.sum())
        # Each turn goes to the source that is furthest behind its share.
        self._turns: list[int] = []
        taken = np.zeros(len(sources))
        for turn in range(1, self.clouds_per_epoch + 1):
            chosen = int(np.argmax(share / share.sum() * turn - taken))
            taken[chosen] += 1
            self._turns.append(chosen)
        if not taken.all():
            raise UsageError(f"a weight of the mixture is too small for a turn in {self.clouds_per_epoch} clouds")

    def cloud(self, epoch: int, index: int, seed: int) -> LabeledCloud:
        """See `DataSource.cloud`."""
        chosen = self._turns[index]
        source = self._sources[chosen]
        position = epoch * self._turns.count(chosen) + self._turns[:index].count(chosen)
        own_epoch, own_index = divmod(position, source.clouds_per_epoch)
        own_seed = int(np.random.SeedSequence([seed, chosen]).generate_state(1)[0])  # else corruptions would agree
        return source.cloud(own_epoch, own_index, own_seed)


def open_dataset(
    paths: Sequence[Path | str],
    *,
    synthetic: bool = False,
    scans: bool = False,
    list_file: str | None = None,
    default_list: str = TRAINING_LIST,
    weights: Sequence[float] | None = None,
    clouds_per_epoch: int = CLOUDS_PER_EPOCH,
    points: int = POINTS_PER_CLOUD,
    relief: float = 0.0,
) -> DataSource:
    """Open folders of training data, each by what lies in it, as one source.

    A folder with .normals files is a PCPNet folder: its clouds are those of `list_file`, else of
    `default_list` where there is one, else all with normals, corrupted anew in each epoch.
    Any other folder must hold meshes.

    Args:
        paths: folders.
        synthetic: adds random procedural solids.
        scans: adds scans by virtual scanners, of the meshes in the folders and of procedural solids.
        list_file: name of the list in the PCPNet folders.
        default_list: name of the list where `list_file` is None.
        weights: share of each source in the mixture, in the order of `paths`, then the solids, then the scans; by
            default as many clouds as it has per epoch.
        clouds_per_epoch: clouds that a folder of meshes, the solids, and the scans give per epoch.
        points: largest number of points of a cloud drawn from a mesh or a solid.
        relief: share of the clouds of meshes, solids and scans that get a fine relief.

    Raises:
        InputError: a folder is missing or holds neither, or its list does not fit it.
        UsageError: there is no source at all, or the weights do not fit them.
    """
    if not paths and not synthetic and not scans:
        raise UsageError("there is no training data: give a folder or ask for synthetic solids")
    sources: list[DataSource] = []
    for path in paths:
        path = Path(path)
        chosen = default_list if list_file is None and (path / default_list).is_file() else list_file
        sources.append(_open_folder(path, chosen, clouds_per_epoch, points))
    if synthetic:
        sources.append(SyntheticSolids(clouds_per_epoch, points))
    if scans:
        folders = [source.directory for source in sources if isinstance(source, MeshFolder)]
        sources.append(ScannedSurfaces(folders, clouds_per_epoch, points))
    if relief:
        sources = [each if isinstance(each, PcpnetFolder) else WithRelief(each, relief) for each in sources]
    return sources[0] if len(sources) == 1 and weights is None else Mixture(sources, weights)


def _open_folder(directory: Path, list_file: str | None, clouds_per_epoch: int, points: int) -> DataSource:
    if not directory.is_dir():
        raise InputError(f"{directory}: no such folder")
    if any(directory.glob("*.normals")):
        return PcpnetFolder(directory, list_file)
    if meshes_in(directory):
        return MeshFolder(directory, clouds_per_epoch, points)
    raise InputError(f"{directory}: holds neither PCPNet clouds (.xyz with .normals) nor meshes")
