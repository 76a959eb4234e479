"""How failures are told: options in the words of the command line, and as JSON where that is asked for."""

from __future__ import annotations

import json

import pytest

import jetnormal
from jetnormal.cli.app import main
from jetnormal.cli.failures import report_failure, spell
from jetnormal.cli.options import set_verbosity
from jetnormal.errors import ResourceError
from jetnormal.support.report import configure_logging, logger


@pytest.mark.parametrize(
    ("message", "spelled"),
    [
        ("`viewpoint_attribute` contradicts `viewpoint`", "--viewpoint-attribute contradicts --viewpoint"),
        ("leave `orient=none` out", "leave --orient none out"),
        ("use `overwrite` to replace it", "use --force to replace it"),
        ("a `b c` d", "a `b c` d"),
    ],
)
def test_options_of_the_library_become_flags(message, spelled):
    assert spell(message) == spelled


def test_options_in_the_log_become_flags_on_the_command_line_alone(capsys):
    set_verbosity(quiet=False, verbose=False)
    logger.warning("%s is kept: go on with `resume`", "scan.ply.tiles")
    configure_logging(0)  # as a program that uses the library
    logger.warning("go on with `resume`")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "jetnormal: warning: scan.ply.tiles is kept: go on with --resume",
        "jetnormal: warning: go on with `resume`",
    ]


def test_a_library_that_a_limit_on_memory_keeps_out_is_a_lack_of_memory(capsys):
    error = ImportError("_flapack.so: failed to map segment from shared object")
    assert report_failure(error) == ResourceError.exit_code
    assert "out of memory" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["estimate", "missing.ply", "-o", "out.ply"], 3, "missing.ply"),
        (
            ["estimate", "in.ply", "-o", "out.ply", "--orient", "up", "--viewpoint", "0,0,1"],
            2,
            "--viewpoint contradicts",
        ),
        (["estimate", "in.ply", "-o", "out.ply", "--k", "0"], 2, "--k"),
        (["estimate", "in.ply", "-o", "out.ply", "--nonsense"], 2, "--nonsense"),
        (["estimate", "in.ply", "-o", "out.ply", "--model", "jt"], 4, "did you mean jet?"),
        (["reconstruct", "missing.ply", "-o", "out.ply"], 3, "missing.ply"),
        (["preview", "missing.ply", "-o", "out.png"], 3, "missing.ply"),
        (["evaluate", "--data", "nowhere", "--model", "jet"], 3, "nowhere"),
        (["models", "nonesuch"], 4, "nonesuch"),
    ],
)
def test_a_failure_under_json_is_an_object_on_stdout(arguments, code, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["jetnormal", *arguments, "--json"])
    with pytest.raises(SystemExit) as leaving:
        main()
    assert leaving.value.code == code
    captured = capsys.readouterr()
    found = json.loads(captured.out)
    assert found["jetnormal"] == jetnormal.__version__ and found["schema"] == 1
    assert found["code"] == code and words in found["error"] and "\n" not in found["error"]
    assert words in captured.err and list(tmp_path.iterdir()) == []
