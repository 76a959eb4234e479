from __future__ import annotations

import gc
import sys

from jetnormal.support.imports import imported_meanwhile, uncollected


def test_modules_are_there_when_the_body_ends(monkeypatch, tmp_path):
    (tmp_path / "imported_beside.py").write_text("VALUE = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    with imported_meanwhile("no_such_library", "imported_beside"):
        pass
    assert sys.modules["imported_beside"].VALUE == 3
    assert "no_such_library" not in sys.modules
    assert gc.isenabled()


def test_garbage_is_collected_again_only_if_it_was():
    with uncollected():
        assert not gc.isenabled()
        with uncollected():
            pass
        assert not gc.isenabled()
    assert gc.isenabled()
