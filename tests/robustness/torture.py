"""Commands that are killed, have no disk or may not write: `make torture`, or

    PYTHONPATH=tests python -m robustness.torture --kills 50 [--seed 1] [--command estimate ...]

kills `estimate`, `train` and `evaluate` at random moments (with SIGKILL, SIGTERM and SIGINT in turn), looks at what is
left, goes on (train --resume, evaluate --results) and compares the end, bit for bit, with a run that nobody disturbed.
Each command runs in a fork of this process, so that a kill meets the work and not the import of PyTorch.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from robustness.record import record_rows
from shapes import sphere

import jetnormal
from jetnormal.cli.app import main as jetnormal_main

SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
NOBODY = 65534
TINY = ("width=0.125", "transform_width=0.125", "neighbors=16", "batch_size=16", "patches_per_cloud=32",
        "clouds_per_epoch=1", "points_per_cloud=300", "validation_patches=20", "bfloat16=false")  # fmt: skip
LONGEST = 600.0  # seconds of a run that nobody disturbs


@dataclass
class Outcome:
    """What was seen of a command: how often it was tried, was killed before its end, and what was wrong."""

    name: str
    tries: int = 0
    killed: int = 0
    faults: list[str] = field(default_factory=list)


def start(arguments: list[str], folder: Path, prepare: Callable[[], None] = lambda: None) -> int:
    """Run a command in a fork, in a folder; its output goes to the file `said` beside the folder."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # a Ctrl-C before the `try` would unwind this program in the fork
    pid = os.fork()
    if pid:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        return pid
    code = 99
    try:
        try:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
            said = os.open(folder.with_name("said"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(said, 1)
            os.dup2(said, 2)
            os.chdir(folder)
            prepare()
            sys.argv = ["jetnormal", *arguments]
            jetnormal_main()
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else 0 if leaving.code is None else 1
        except KeyboardInterrupt:
            code = 130
        with contextlib.suppress(OSError):
            sys.stdout.flush()
    finally:
        os._exit(code)


def finish(pid: int, seconds: float = LONGEST) -> int:
    """Wait for a fork; its exit code, negative for a signal."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return 98


def kill_at(pid: int, moment: float, number: int) -> bool:
    """Send a signal to a fork after some seconds; whether it was still there."""
    end = time.monotonic() + moment
    while time.monotonic() < end:
        done, _ = os.waitpid(pid, os.WNOHANG)
        if done:
            return False
        time.sleep(0.001)
    os.kill(pid, number)
    return True


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def strays(folder: Path) -> list[str]:
    """Unfinished files; the lock of a training stays."""
    return [path.name for path in folder.rglob(".*") if path.suffix in (".tmp", ".old")]


def torture(
    name: str, inputs: Path, command: list[str], again: list[str], result: str, kills: int, rng: random.Random
) -> Outcome:
    """Kill a command at random moments.

    Args:
        name: of the command.
        inputs: folder whose content each run finds.
        command: arguments of the first run.
        again: of the run that goes on after a kill; empty if nothing can go on.
        result: file that must be there complete or not at all, and at the end the same as without a kill.
        kills: number of them; a run that ends before its kill does not count.
        rng: chooses the moments.
    """
    outcome = Outcome(name)
    with tempfile.TemporaryDirectory(prefix="torture-") as text:
        folder = Path(text) / "work"
        shutil.copytree(inputs, folder)
        begun = time.monotonic()
        code = finish(start(command, folder))
        duration = time.monotonic() - begun
        if code:
            raise SystemExit(f"{name}: fails undisturbed ({code}): {folder.with_name('said').read_text()[-500:]}")
        expected = (folder / result).read_bytes()
        while outcome.killed < kills:
            number = outcome.tries
            shutil.rmtree(folder)
            shutil.copytree(inputs, folder)
            chosen = SIGNALS[number % len(SIGNALS)]
            begun = time.monotonic()
            pid = start(command, folder)
            killed = kill_at(pid, rng.uniform(0, duration), chosen)
            code = finish(pid, 60) if killed else 0
            duration = duration if killed else time.monotonic() - begun  # the machine has less to do than it had
            outcome.tries += 1
            outcome.killed += killed
            print(f"{name}: {outcome.killed} of {kills} killed", file=sys.stderr)
            where = f"try {number}, {chosen.name}"
            if killed and code not in (0, -chosen, 128 + chosen):
                outcome.faults.append(f"{where}: exit code {code}")
            if killed and chosen != signal.SIGKILL and strays(folder):
                outcome.faults.append(f"{where}: leaves {strays(folder)}")
            found = folder / result
            if not again and found.exists() and found.read_bytes() != expected:
                outcome.faults.append(f"{where}: {result} is there and not complete")
            if again:
                resumed = again if (folder / "run" / "state.safetensors").exists() or name != "train" else command
                code = finish(start(resumed, folder))
                if code:
                    said = folder.with_name("said").read_text()[-300:]
                    outcome.faults.append(f"{where}: does not go on ({code}): {said}")
                elif found.read_bytes() != expected:
                    outcome.faults.append(f"{where}: {result} differs after going on")
    return outcome


def without_disk(inputs: Path, commands: dict[str, list[str]], results: dict[str, str]) -> Outcome:
    """Files that may not grow, as on a full disk; a full device behind stdout; folders that may not be written.

    Each must end with exit code 3, without a traceback, a result or an unfinished file.
    """
    outcome = Outcome("no disk, no permission")

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))

    def full_stdout() -> None:
        os.dup2(os.open("/dev/full", os.O_WRONLY), 1)

    def other_user() -> None:
        os.setuid(NOBODY)

    cases = [(name, "file size", limit, command) for name, command in commands.items()]
    cases.append(("estimate", "full stdout", full_stdout, [*commands["estimate"], "--json"]))
    if os.geteuid() == 0:
        for command in commands.values():
            import_all(inputs, command)
        cases += [(name, "read-only folder", other_user, command) for name, command in commands.items()]
    for name, problem, prepare, arguments in cases:
        with tempfile.TemporaryDirectory(prefix="torture-") as text:
            Path(text).chmod(0o755)
            folder = Path(text) / "work"
            shutil.copytree(inputs, folder)
            code = finish(start(arguments, folder, prepare))
            outcome.tries += 1
            said = folder.with_name("said").read_text()
            if code != 3 or "Traceback" in said:
                outcome.faults.append(f"{name}, {problem}: exit code {code}, {said[-300:]}")
            if strays(folder) or (problem != "full stdout" and list(folder.glob(results[name]))):
                outcome.faults.append(f"{name}, {problem}: leaves {list(contents(folder))}")
    return outcome


def import_all(inputs: Path, command: list[str]) -> None:
    """Run a command once in this process: another user may not read where Python lies."""
    here = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="torture-") as text, contextlib.suppress(SystemExit):
        shutil.copytree(inputs, Path(text) / "work")
        os.chdir(Path(text) / "work")
        sys.argv = ["jetnormal", *command, "--quiet"]
        with contextlib.redirect_stdout(None):
            jetnormal_main()
    os.chdir(here)


def prepare_inputs(folder: Path) -> None:
    jetnormal.write(jetnormal.Cloud(sphere(5_000)), folder / "in.ply")
    (folder / "data").mkdir()
    for name, seed in (("one", 1), ("two", 2)):
        points = np.random.default_rng(seed).normal(size=(3000, 3))
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        np.savetxt(folder / "data" / f"{name}.xyz", points, fmt="%.9g")
        np.savetxt(folder / "data" / f"{name}.normals", points, fmt="%.9g")
        np.savetxt(folder / "data" / f"{name}.pidx", np.arange(0, 3000, 3), fmt="%d")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--record", type=Path, metavar="FILE", help="document whose table takes the rows")
    parser.add_argument("--command", action="append", choices=["estimate", "train", "evaluate", "disk"])
    options = parser.parse_args()
    chosen = options.command or ["estimate", "train", "evaluate", "disk"]
    rng = random.Random(options.seed)
    import torch  # noqa: F401 - before the forks

    import jetnormal.estimators.patchwise
    import jetnormal.training.train  # noqa: F401

    train = ["train", "--recipe", "deepfit-small", "--data", "data", "-o", "run", "--epochs", "6", "--threads", "1"]
    commands = {
        "estimate": ["estimate", "in.ply", "-o", "out.ply", "--model", "jet"],
        "train": [*train, *(part for setting in TINY for part in ("--set", setting))],
        "evaluate": ["evaluate", "--data", "data", "--model", "pca", "--model", "jet", "--results", "kept", "--json"],
    }
    results = {"estimate": "out.ply", "train": "run/model.safetensors", "evaluate": "kept/**/*.npz"}
    again = {"estimate": [], "train": ["train", "--resume", "-o", "run"]}
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="torture-") as text:
        inputs = Path(text)
        inputs.chmod(0o755)
        prepare_inputs(inputs)
        for name in again:
            if name in chosen:
                outcomes.append(torture(name, inputs, commands[name], again[name], results[name], options.kills, rng))
        if "evaluate" in chosen:
            outcomes.append(torture_evaluate(inputs, commands["evaluate"], options.kills, rng))
        if "disk" in chosen:
            outcomes.append(without_disk(inputs, commands, results))
    rows = [(outcome.name, [str(outcome.tries), str(outcome.killed), str(len(outcome.faults))]) for outcome in outcomes]
    print("| command | tries | killed before the end | faults |\n|---|---|---|---|")
    for name, cells in rows:
        print("|", " | ".join([name, *cells]), "|")
    if options.record:
        record_rows(options.record, "torture", rows)
    for outcome in outcomes:
        for fault in outcome.faults[:10]:
            print(f"{outcome.name}: {fault}")
    sys.exit(any(outcome.faults for outcome in outcomes))


def torture_evaluate(inputs: Path, command: list[str], kills: int, rng: random.Random) -> Outcome:
    """Kill `evaluate`, let it go on, and compare its scores, but for the times."""
    outcome = Outcome("evaluate")
    with tempfile.TemporaryDirectory(prefix="torture-") as text:
        folder = Path(text) / "work"

        def scores() -> str:
            said = folder.with_name("said").read_text()
            models = json.loads(said[said.index("{") :])["models"]
            return json.dumps([model["categories"] for model in models], default=str)

        def without_times(said: str) -> str:
            kept = json.loads(said)
            for categories in kept:
                for category in categories.values():
                    for key in [key for key in category if "second" in key]:
                        del category[key]
            return json.dumps(kept)

        shutil.copytree(inputs, folder)
        begun = time.monotonic()
        if finish(start(command, folder)):
            raise SystemExit(f"evaluate: fails undisturbed: {folder.with_name('said').read_text()[-500:]}")
        duration = time.monotonic() - begun
        expected = without_times(scores())
        while outcome.killed < kills:
            number = outcome.tries
            shutil.rmtree(folder)
            shutil.copytree(inputs, folder)
            chosen = SIGNALS[number % len(SIGNALS)]
            begun = time.monotonic()
            pid = start(command, folder)
            killed = kill_at(pid, rng.uniform(0, duration), chosen)
            if killed:
                finish(pid, 60)
            duration = duration if killed else time.monotonic() - begun
            outcome.tries += 1
            outcome.killed += killed
            print(f"evaluate: {outcome.killed} of {kills} killed", file=sys.stderr)
            code = finish(start(command, folder))
            if code or without_times(scores()) != expected:
                outcome.faults.append(f"try {number}, {chosen.name}: goes on to something else ({code})")
    return outcome


if __name__ == "__main__":
    main()
