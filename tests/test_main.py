from __future__ import annotations

import os

import pytest

from jetnormal.__main__ import VECTORS, _use_long_vectors

FLAGS = " ".join(sorted(VECTORS))


@pytest.mark.parametrize(
    ("said", "given", "expected"),
    [
        (f"vendor_id\t: AuthenticAMD\nflags\t\t: fpu {FLAGS}\n", None, "SkylakeX"),
        (f"vendor_id\t: AuthenticAMD\nflags\t\t: fpu {FLAGS}\n", "Zen", "Zen"),
        ("vendor_id\t: AuthenticAMD\nflags\t\t: fpu avx2 avx512f\n", None, None),
        (f"vendor_id\t: GenuineIntel\nflags\t\t: fpu {FLAGS}\n", None, None),
        (None, None, None),
    ],
)
def test_openblas_is_told_of_long_vectors_where_it_does_not_know(monkeypatch, tmp_path, said, given, expected):
    monkeypatch.setenv("OPENBLAS_CORETYPE", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_CORETYPE")
    path = tmp_path / "cpuinfo"
    if said is not None:
        path.write_text(said)
    _use_long_vectors(path)
    assert os.environ.get("OPENBLAS_CORETYPE") == expected
