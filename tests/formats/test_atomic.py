from __future__ import annotations

import errno
import os
import resource

import pytest

from jetnormal.errors import InputError
from jetnormal.formats.atomic import atomic_folder, atomic_write, check_target


def test_a_new_file_appears_with_the_usual_permissions(tmp_path):
    path = tmp_path / "out.bin"
    with atomic_write(path) as stream:
        stream.write(b"data")
        assert not path.exists()
    assert path.read_bytes() == b"data"
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    assert sorted(os.listdir(tmp_path)) == ["out.bin", "plain"]  # noqa: PTH208


@pytest.mark.parametrize("problem", [RuntimeError, KeyboardInterrupt])
def test_any_failure_leaves_the_old_file_and_no_other(tmp_path, problem):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    with pytest.raises(problem), atomic_write(path, overwrite=True) as stream:
        stream.write(b"new")
        raise problem
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.bin"]


def test_a_file_that_may_not_grow_is_an_input_error(tmp_path):
    """The limit on file sizes makes the system refuse the write, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        with pytest.raises(InputError, match="cannot be written"), atomic_write(tmp_path / "a") as stream:
            stream.write(b"x" * 20_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_says_so(tmp_path):
    with pytest.raises(InputError, match=r"No space left on device.*free some space"), atomic_write(tmp_path / "a"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_needs_force(tmp_path):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match=r"out\.bin: already exists; use `overwrite`"), atomic_write(path):
        pass
    with atomic_write(path, overwrite=True) as stream:
        stream.write(b"new")
    assert path.read_bytes() == b"new"


def test_a_link_is_followed_and_permissions_are_kept(tmp_path):
    path, link = tmp_path / "out.bin", tmp_path / "link"
    path.touch()
    path.chmod(0o640)
    link.symlink_to(path)
    with atomic_write(link, overwrite=True) as stream:
        stream.write(b"new")
    assert link.is_symlink()
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("folder", "is a folder"),
        ("missing/a", "does not exist"),
        ("pipe", "not a regular file"),
        ("n" * 300, "too long"),
    ],
)
def test_unsuitable_targets(tmp_path, target, message):
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match=message):
        check_target(tmp_path / target, overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_write_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="not writable"):
        check_target(tmp_path / "a", overwrite=False)


def test_a_folder_appears_when_it_is_complete(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with atomic_folder(tmp_path / "out", ["old"]) as folder:
        (folder / "new").touch()
        assert [path.name for path in (tmp_path / "out").iterdir()] == ["old"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["new"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("problem", [RuntimeError, KeyboardInterrupt])
def test_any_failure_leaves_the_old_folder_and_no_other(tmp_path, problem):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "old").touch()
    with pytest.raises(problem), atomic_folder(tmp_path / "out", ["old"]) as folder:
        (folder / "new").touch()
        raise problem
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["old"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(InputError, match="create it first"), atomic_folder(tmp_path / "absent" / "out"):
        pass
    with pytest.raises(InputError, match="free some space"), atomic_folder(tmp_path / "a"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_anything_else_stays(tmp_path):
    (tmp_path / "out").mkdir()
    for name in ("old", "mine"):
        (tmp_path / "out" / name).touch()
    with pytest.raises(InputError, match="holds mine"), atomic_folder(tmp_path / "out", ["old"]) as folder:
        (folder / "new").touch()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["mine", "old"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_a_planted_link_is_not_followed(tmp_path, monkeypatch):
    """Whoever guesses the temporary name still does not get the content into another file."""
    monkeypatch.setattr("secrets.token_hex", lambda size: "guessed")
    (tmp_path / "precious").write_bytes(b"mine")
    (tmp_path / ".out.bin.guessed.tmp").symlink_to(tmp_path / "precious")
    with pytest.raises(InputError, match="cannot be written"), atomic_write(tmp_path / "out.bin") as stream:
        stream.write(b"new")
    assert (tmp_path / "precious").read_bytes() == b"mine"


def test_writers_of_one_file_do_not_tear_it(tmp_path):
    path = tmp_path / "out.bin"
    with atomic_write(path) as first, atomic_write(path) as second:
        first.write(b"1" * 10)
        second.write(b"2" * 10)
        first.write(b"1" * 10)
    assert path.read_bytes() in (b"1" * 20, b"2" * 10)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.bin"]


def test_what_nobody_else_may_read_never_lies_open(tmp_path):
    path = tmp_path / "out.bin"
    path.touch(mode=0o600)
    with atomic_write(path, overwrite=True) as stream:
        (unfinished,) = (entry for entry in tmp_path.iterdir() if entry != path)
        stream.write(b"secret")
        assert unfinished.stat().st_mode & 0o777 == 0o600


def test_a_loop_of_links_is_an_input_error(tmp_path):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(InputError, match="cannot be written"):
        check_target(tmp_path / "a", overwrite=True)


def test_a_loop_of_links_is_no_place_for_a_folder(tmp_path):
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError, match="loop: cannot be written"), atomic_folder(tmp_path / "loop"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["loop"]
