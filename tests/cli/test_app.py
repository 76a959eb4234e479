from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import types

import pytest
from typer.main import get_command
from typer.testing import CliRunner

import jetnormal
from jetnormal import errors
from jetnormal.cli.app import app, main
from jetnormal.formats.registry import suffixes
from jetnormal.jobs.options import EstimateOptions, FileOptions, LargeOptions

COMMANDS = sorted(get_command(app).commands)
SUMMARY = {
    "input": "in.ply",
    "output": "out.ply",
    "points": 1000,
    "valid": 990,
    "model": "jet",
    "orient": {"asked": "mst", "used": "mst", "reason": "it was asked for", "open_share": 0.0, "confidence": 0.9},
    "seconds": {"read": 0.5, "estimate": 1.5},
    "points_per_second": 660.0,
    "peak_memory_mb": 120.0,
    "warnings": ["10 points are not finite"],
}


@pytest.fixture
def estimation(monkeypatch):
    """Stand-in for the module behind `jetnormal estimate`; a test sets its `result`."""
    module = types.ModuleType("jetnormal.jobs.estimate")
    module.result = SUMMARY
    module.calls = []

    def estimate_file(input, output, options, files, large, *, overwrite):
        module.calls.append((input, output, options, files, large, overwrite))
        if isinstance(module.result, BaseException):
            raise module.result
        return module.result

    module.estimate_file = estimate_file
    monkeypatch.setitem(sys.modules, "jetnormal.jobs.estimate", module)
    return module


def run(monkeypatch, *arguments) -> int:
    """Run the program in this process and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["jetnormal", *arguments])
    with pytest.raises(SystemExit) as leaving:
        main()
    return leaving.value.code or 0


def python(code: str, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, **options)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_shows_an_example_that_runs_it(command):
    result = CliRunner().invoke(app, [command, "--help"])
    assert result.exit_code == 0
    examples = result.output.partition("Examples:")[2].partition("Arguments:")[0]
    assert f"jetnormal {command} " in examples


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command_fits_two_screens_of_50_lines(command):
    result = CliRunner().invoke(app, [command, "--help"], terminal_width=80)
    assert len(result.output.splitlines()) <= 100


@pytest.mark.parametrize("command", ["estimate", "reconstruct", "preview"])
def test_help_names_every_suffix_and_its_argument_plainly(command):
    shown = CliRunner().invoke(app, [command, "--help"]).output
    assert set(suffixes()) <= set(shown.replace("(", " ").replace(",", " ").replace(")", " ").split())
    assert "{" not in shown and "<path>" not in shown and "Path]" not in shown


def test_help_lists_every_command_and_exit_code():
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    for command in COMMANDS:
        assert f"\n  {command} " in result.output
    for code in (0, 2, 3, 4, 5, errors.INTERRUPTED):
        assert f"{code} " in result.output


def test_version_is_the_package_version():
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.output == f"jetnormal {jetnormal.__version__}\n"


@pytest.mark.parametrize("arguments", [["--help"], ["estimate", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments):
    code = f"""
import sys
from jetnormal.cli.app import main
sys.argv = ["jetnormal", *{arguments!r}]
try:
    main()
finally:
    heavy = {{"torch", "scipy", "open3d", "plyfile", "rich", "numpy", "matplotlib"}} & set(sys.modules)
    print("heavy:", sorted(heavy), file=sys.stderr)
"""
    result = python(code)
    assert result.returncode == 0
    assert result.stderr == "heavy: []\n"


def test_importing_the_package_imports_nothing_heavy():
    modules = ("cloud", "errors", "support.report", "formats", "cli.app")
    imports = "; ".join(f"import jetnormal.{module}" for module in modules)
    result = python(f"{imports}; import sys; print({{'torch', 'scipy', 'open3d', 'plyfile'}} & set(sys.modules))")
    assert result.stdout == "set()\n", result.stderr


def test_public_names_come_from_their_modules():
    from jetnormal import cloud, formats

    assert jetnormal.read is formats.read
    assert jetnormal.Cloud is cloud.Cloud
    assert set(jetnormal.__all__) <= set(dir(jetnormal))
    with pytest.raises(AttributeError, match="no attribute 'raed'"):
        jetnormal.raed  # noqa: B018


@pytest.mark.parametrize("name", jetnormal.__all__)
def test_every_public_name_can_be_imported(name):
    assert getattr(jetnormal, name) is not None


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (errors.UsageError("bad order"), 2),
        (errors.InputError("scan.ply: not a point cloud"), 3),
        (errors.ModelError("no model named x"), 4),
        (errors.ResourceError("no CUDA device"), 5),
        (errors.JetnormalError("something\nelse"), 1),
        (MemoryError(), 5),
        (ZeroDivisionError("division by zero"), 1),
    ],
)
def test_every_error_is_one_line_and_its_exit_code(error, code, estimation, monkeypatch, capsys):
    estimation.result = error
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply") == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("jetnormal: error: ")
    assert captured.err.count("\n") == 1
    assert " ".join(str(error).split()) in captured.err


def test_unexpected_error_points_to_verbose_which_shows_the_traceback(estimation, monkeypatch, capsys):
    estimation.result = ZeroDivisionError("division by zero")
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply") == 1
    told = capsys.readouterr().err
    assert "please report it" in told and told.count("\n") == 1
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply", "-v") == 1
    shown = capsys.readouterr().err
    assert "Traceback (most recent call last)" in shown
    assert "jetnormal: error: ZeroDivisionError: division by zero; this should not happen" in shown


def test_interrupt_exits_130_without_traceback(estimation, monkeypatch, capsys):
    estimation.result = KeyboardInterrupt()
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply") == errors.INTERRUPTED
    assert "Traceback" not in capsys.readouterr().err


def test_an_error_of_a_lock_that_was_interrupted_exits_130(estimation, monkeypatch, capsys):
    estimation.result = RuntimeError("cannot release un-acquired lock")
    estimation.result.__context__ = KeyboardInterrupt()
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply") == errors.INTERRUPTED
    assert capsys.readouterr().err == ""


def test_an_interrupt_while_modules_are_imported_exits_130_without_traceback(tmp_path):
    """Ctrl-C in the first moments comes while the command line is imported."""
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt\n")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    command = [sys.executable, "-m", "jetnormal", "estimate", "in.ply", "-o", "out.ply"]
    ended = subprocess.run(command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (errors.INTERRUPTED, "")


def test_a_limit_on_memory_that_libraries_abort_under_is_refused(tmp_path):
    resource = pytest.importorskip("resource")
    limit = 600_000 * 1024
    command = [sys.executable, "-m", "jetnormal", "estimate", str(tmp_path / "in.xyz"), "-o", "out.ply"]
    ended = subprocess.run(
        command,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (limit, limit)),
        capture_output=True,
        text=True,
    )
    assert ended.returncode == errors.ResourceError.exit_code
    assert ended.stderr == (
        "jetnormal: error: the limit on memory (ulimit -v 600000) is too low to load the libraries; "
        "set it to 716800 or more\n"
    )


@pytest.mark.parametrize(
    "arguments",
    [
        ["estimate"],
        ["estimate", "in.ply"],
        ["estimate", "in.ply", "-o", "out.ply", "--orient", "sideways"],
        ["estimate", "in.ply", "-o", "out.ply", "--viewpoint", "1,2"],
        ["estimate", "in.ply", "-o", "out.ply", "--batch-size", "0"],
        ["estimate", "in.ply", "-o", "out.ply", "-q", "-v"],
        ["estimate", "in.ply", "-o", "out.ply", "--unknown"],
        ["estimate", "a.ply", "b.ply", "-o", "out.ply"],
        ["estimate", "in.ply", "-o", "out.ply", "--out-dir", "out"],
        ["estimate", "in.ply", "-o", "out.ply", "--skip-existing"],
        ["estimate", "in.ply", "--out-dir", "out", "--mesh", "mesh.ply"],
        ["estimate", "-", "--out-dir", "out", "--format", "ply"],
        ["evaluate", "--data", "d", "--model", "pca", "--plots", "p", "--up", "0,0,0"],
        ["estimate", "in.ply", "-o", "out.ply", "--max-memory", f"{'9' * 400}GB"],
        ["estimate", "in.ply", "-o", "-", "--format", "ply", "--mesh", "mesh.ply"],
        ["unknown"],
    ],
)
def test_wrong_usage_exits_2(arguments, estimation, monkeypatch, capsys):
    assert run(monkeypatch, *arguments) == 2
    assert capsys.readouterr().out == ""
    assert estimation.calls == []


def test_a_wrong_choice_names_the_option_and_the_choices(estimation, monkeypatch, capsys):
    assert run(monkeypatch, "estimate", "a.ply", "-o", "b.ply", "--orient", "upp") == 2
    message = (
        "Invalid value for '--orient': 'upp' is not one of auto, global, mst, viewpoint, up, none; did you mean up?"
    )
    assert message in capsys.readouterr().err
    assert run(monkeypatch, "evaluate", "--data", "d", "--format", "x") == 2
    assert "Invalid value for '--format': 'x' is not one of rich, markdown, latex, csv\n" in capsys.readouterr().err


def test_estimate_hands_over_its_options(estimation, monkeypatch):
    arguments = "estimate in.ply -o out.pcd --model jet --k 32 --order 2 --iterations 3 --orient viewpoint"
    arguments += " --viewpoint -1,2.5,3e2 --curvature --confidence --batch-size 64 --device cpu --threads 2"
    arguments += " --encoding ascii --force --max-memory 2GB --resume"
    assert run(monkeypatch, *arguments.split()) == 0
    ((source, target, options, files, large, overwrite),) = estimation.calls
    assert (str(source), str(target)) == ("in.ply", "out.pcd")
    assert files == FileOptions(encoding="ascii")
    assert large == LargeOptions(max_memory=2 * 10**9, resume=True)
    assert overwrite
    assert options == EstimateOptions(
        "jet",
        k=32,
        order=2,
        iterations=3,
        orient="viewpoint",
        viewpoint=(-1.0, 2.5, 300.0),
        curvature=True,
        confidence=True,
        batch_size=64,
        device="cpu",
        threads=2,
    )


def test_estimate_defaults_are_those_of_the_library(monkeypatch):
    from jetnormal.jobs import estimate as estimation

    seen = []
    monkeypatch.setattr(estimation, "estimate_file", lambda *arguments, **file: seen.append(arguments) or SUMMARY)
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply") == 0
    assert seen[0][2] == EstimateOptions()


def test_json_is_alone_on_stdout(estimation, monkeypatch, capsys):
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply", "--json") == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"jetnormal": jetnormal.__version__, "schema": 1, **SUMMARY}
    assert "warning: 10 points are not finite" in captured.err
    assert "990 of 1,000 points" in captured.err


def test_quiet_prints_nothing(estimation, monkeypatch, capsys):
    assert run(monkeypatch, "estimate", "in.ply", "-o", "out.ply", "-q") == 0
    assert capsys.readouterr() == ("", "")


STAND_IN = """
import sys, types
module = types.ModuleType("jetnormal.jobs.estimate")
module.estimate_file = lambda *arguments, **file: {action}
sys.modules["jetnormal.jobs.estimate"] = module
sys.argv = ["jetnormal", "estimate", "in.ply", "-o", "out.ply", "--json"]
from jetnormal.cli.app import main
main()
"""


def test_closed_pipe_gives_no_traceback():
    reader, writer = os.pipe()
    os.close(reader)
    code = STAND_IN.format(action=repr(SUMMARY))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    shown = process.communicate(timeout=60)[1]
    assert process.returncode == 1
    assert "Traceback" not in shown
    assert "BrokenPipe" not in shown


SLOW_WRITE = """
def write_slowly(path):
    import time
    from jetnormal.formats.atomic import atomic_write
    with atomic_write(path) as stream:
        print("ready", flush=True)
        time.sleep(60)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_ends_the_process_with_its_code_and_leaves_no_unfinished_file(tmp_path, name):
    number = getattr(signal, name)
    code = SLOW_WRITE + STAND_IN.format(action="write_slowly(arguments[1])")
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),  # nohup and & let children ignore some signals
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    assert len(list(tmp_path.iterdir())) == 1
    process.send_signal(number)
    shown = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + number
    assert "Traceback" not in shown
    assert list(tmp_path.iterdir()) == []


def test_an_ignored_hangup_stays_ignored(monkeypatch):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        run(monkeypatch, "--version")
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("redirection", ["2>&-", "2>/dev/full", "2>&- >&-"])
@pytest.mark.parametrize(("action", "code"), [(repr(SUMMARY), 0), ("__import__('jetnormal').read('missing.ply')", 3)])
def test_a_stderr_that_takes_nothing_does_not_change_how_the_program_ends(redirection, action, code):
    command = [sys.executable, "-c", STAND_IN.format(action=action)]
    assert subprocess.run(f"{shlex.join(command)} {redirection}", shell=True, timeout=60).returncode == code


def test_shell_completion_completes_commands_and_choices():
    def complete(line: str) -> list[str]:
        words = {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1)}
        environment = {**os.environ, "_JETNORMAL_COMPLETE": "complete_bash", **words}
        return python("from jetnormal.cli.app import main; main()", env=environment).stdout.split()

    assert complete("jetnormal est") == ["estimate"]
    assert complete("jetnormal estimate --orient vi") == ["viewpoint"]
    assert complete("jetnormal estimate --model clo") == ["cloudfit"]
    assert complete("jetnormal evaluate --model p") == ["pca"]
    assert complete("jetnormal models deepf") == ["deepfit-small"]
    assert complete("jetnormal export adaf") == ["adafit-small"]
    assert complete("jetnormal train --initial itern") == ["iternet"]
    assert complete("jetnormal train --recipe nestinet-p") == ["nestinet-paper"]
