"""Damaged files for every reader, in child processes with limits: `make fuzz`, or

    PYTHONPATH=tests python -m robustness.fuzz --seconds 600 [--inputs 100000] [--reader ply ...] [--seed 1]

prints a table of inputs and outcomes, and with `--record FILE` puts its rows into that of benchmarks/robustness.md.
An input is told by the reader, the seed and its number; `--keep FOLDER` writes one of each kind of fault. A fault is an
error that is none of jetnormal's own, a process that ends by a signal, a second of processor time, or more memory than
the reader's bound.

A child reads thousands of inputs, one after the other. It notes the number of each in memory that it shares with its
parent before it reads it, so that the parent knows what ended a child, and goes on behind it in another one.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from robustness.mutate import mutated
from robustness.readers import READERS
from robustness.record import record_rows

from jetnormal.errors import JetnormalError, ResourceError

SLOW = 1.0  # seconds of processor time that an input may take
STUCK = 120.0  # seconds without another input, after which a child is ended
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None  # a disk takes longer than a reader
CHILD = 20_000  # inputs, after which a fresh child takes over
FAULTS = ("raised", "killed", "slow", "stuck", "memory")
OUTCOMES = ("read", "refused", *FAULTS)
COLUMNS = ("inputs", *OUTCOMES, "slowest")


@dataclass
class Result:
    """What became of a reader's inputs, and the first number of each kind of fault."""

    name: str
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(OUTCOMES, 0))
    slowest: float = 0.0
    faults: dict[tuple[str, str], int] = field(default_factory=dict)

    @property
    def inputs(self) -> int:
        return sum(self.counts.values())

    def row(self) -> list[str]:
        return [f"{self.inputs:,}", *(f"{count:,}" for count in self.counts.values()), f"{self.slowest * 1000:.0f} ms"]

    def add(self, number: int, outcome: str, note: str) -> None:
        self.faults.setdefault((outcome, note), number)


class Progress:
    """What a child tells its parent in a file that both map: the number of its input, what became of those before."""

    SIZE = 2 + len(OUTCOMES)

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(bytes(8 * self.SIZE))
        self._values = np.memmap(path, np.float64, "r+")

    @property
    def number(self) -> int:
        return int(self._values[0])

    def begin(self, number: int) -> None:
        self._values[0] = number

    def end(self, outcome: str, seconds: float) -> None:
        self._values[2 + OUTCOMES.index(outcome)] += 1
        self._values[1] = max(self._values[1], seconds)

    def add_to(self, result: Result) -> None:
        for outcome, count in zip(OUTCOMES, self._values[2:], strict=True):
            result.counts[outcome] += int(count)
        result.slowest = max(result.slowest, float(self._values[1]))


def content(seeds: list[bytes], name: str, seed: int, number: int) -> bytes:
    return mutated(seeds, random.Random(f"{name} {seed} {number}"))


def run_child(name: str, seed: int, first: int, count: int, shared: Path) -> None:
    """Read inputs; the folder `shared` gets the progress, and a line for each fault."""
    warnings.simplefilter("ignore")
    reader = READERS[name]
    progress = Progress(shared / "progress")
    with (
        tempfile.TemporaryDirectory(prefix="fuzz-", dir=MEMORY) as text,
        (shared / "faults").open("w", buffering=1) as faults,
    ):
        folder = Path(text)
        (folder / "seeds").mkdir()
        seeds = reader.seeds(folder / "seeds")
        path = folder / f"a{reader.suffix}"
        for valid in seeds:  # also imports what reading needs
            path.write_bytes(valid)
            reader.read(path)
        _limit_memory(reader.bound)
        for number in range(first, first + count):
            path.write_bytes(content(seeds, name, seed, number))
            progress.begin(number)
            start = time.process_time()
            outcome, note = _outcome(reader.read, path)
            seconds = time.process_time() - start
            if seconds > SLOW:
                outcome, note = "slow", f"then {outcome} {note}"
            progress.end(outcome, seconds)
            if outcome in FAULTS:
                print(json.dumps([number, outcome, re.sub(r"\d+", "N", note.replace(text, ""))]), file=faults)


def _limit_memory(megabytes: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + megabytes * 1_000_000
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _outcome(read: Any, path: Path) -> tuple[str, str]:
    try:
        read(path)
    except ResourceError as error:
        return "memory", str(error)[:200]
    except JetnormalError as error:
        named = str(path.parent) in str(error)
        return ("refused", "") if named else ("raised", f"an error that names no file: {error}"[:200])
    except BaseException as error:
        return "raised", f"{type(error).__name__}: {error}"[:200]
    return "read", ""


def run_reader(name: str, seed: int, count: int, deadline: float) -> Result:
    """Send a reader inputs until there were `count` or the time is over, in as many children as it takes."""
    result = Result(name)
    number = 0
    while number < count and time.monotonic() < deadline:
        number = _run_some(result, seed, number, min(CHILD, count - number), deadline)
        print(f"{name}: {result.inputs:,} inputs, {len(result.faults)} kinds of fault", file=sys.stderr, flush=True)
    return result


def _run_some(result: Result, seed: int, first: int, count: int, deadline: float) -> int:
    """Let one child read inputs, and return the number after its last one."""
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=MEMORY) as text:
        shared = Path(text)
        progress = Progress(shared / "progress")
        progress.begin(first - 1)
        command = [sys.executable, "-m", "robustness.fuzz", "--child"]
        command += [result.name, str(seed), str(first), str(count), text]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        with (shared / "said").open("wb") as said:
            child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said, env=environment)
            late = _wait(child, progress, deadline)
        progress.add_to(result)
        if (shared / "faults").exists():
            for line in (shared / "faults").read_text().splitlines():
                result.add(*json.loads(line))
        number = progress.number
        if late == "time" or child.returncode == 0:
            return number + (late is None)
        if number < first:
            raise SystemExit(f"{result.name}: fails on valid files: {(shared / 'said').read_text()[-500:]}")
        outcome = late or "killed"
        result.counts[outcome] += 1
        result.add(number, outcome, "" if late else _how_it_ended(child.returncode, (shared / "said").read_text()))
        return number + 1


def _wait(child: subprocess.Popen[bytes], progress: Progress, deadline: float) -> str | None:
    """Wait for a child, but no longer than it makes progress ("stuck") and there is time ("time")."""
    seen, since = -1, time.monotonic()
    while True:
        try:
            child.wait(0.2)
            return None
        except subprocess.TimeoutExpired:
            now = time.monotonic()
        if progress.number != seen:
            seen, since = progress.number, now
        late = "stuck" if now - since > STUCK else "time" if now > deadline else None
        if late:
            child.kill()
            child.wait()
            return late


def _how_it_ended(code: int, said: str) -> str:
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    where = re.search(r'File "(.*)", line (\d+) in', said)  # the first line of faulthandler's stack
    return f"{how} in {where.group(1)}:{where.group(2)}" if where else f"{how}: {said[-200:]}"


def keep_faults(results: list[Result], seed: int, folder: Path) -> None:
    """Write one input of each kind of fault."""
    folder.mkdir(parents=True, exist_ok=True)
    for result in results:
        with tempfile.TemporaryDirectory() as text:
            seeds = READERS[result.name].seeds(Path(text))
        for number in result.faults.values():
            name = f"{result.name.replace(' ', '-')}-{seed}-{number}{READERS[result.name].suffix}"
            (folder / name).write_bytes(content(seeds, result.name, seed, number))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--inputs", type=int, default=10**9, help="of each reader, at most")
    parser.add_argument("--reader", action="append", choices=list(READERS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for one input of each kind of fault")
    parser.add_argument("--record", type=Path, metavar="FILE", help="document whose table takes the rows")
    parser.add_argument("--child", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        faulthandler.enable()
        name, *numbers, shared = options.child
        run_child(name, *map(int, numbers), Path(shared))
        return
    names = [name for name in options.reader or READERS if READERS[name].available]
    results = []
    start = time.monotonic()
    for done, name in enumerate(names):  # each gets an equal share of what is left
        share = (start + options.seconds - time.monotonic()) / (len(names) - done)
        results.append(run_reader(name, options.seed, options.inputs, time.monotonic() + share))
        if options.record:
            record_rows(options.record, "fuzz", [(name, results[-1].row())])
    print_table(results)
    if options.keep:
        keep_faults(results, options.seed, options.keep)
    sys.exit(any(result.faults for result in results))


def print_table(results: list[Result]) -> None:
    for cells in (("reader", *COLUMNS), ["---"] * (1 + len(COLUMNS)), *((r.name, *r.row()) for r in results)):
        print("|", " | ".join(cells), "|")
    for result in results:
        for (outcome, note), number in result.faults.items():
            print(f"{result.name} {number}: {outcome}: {note}")


if __name__ == "__main__":
    main()
