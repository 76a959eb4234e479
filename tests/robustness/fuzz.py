"""Damaged files for every reader, in child processes with limits: `make fuzz`, or

    PYTHONPATH=tests python -m robustness.fuzz --seconds 600 [--reader ply ...] [--seed 1]

prints a table of inputs, outcomes and the slowest. Each input is told by the reader, the seed and its number, so that
`--reader ply --seed 1 --only 1234 --keep FOLDER` makes it again. A fault is an error that is none of jetnormal's own, a
process that ends by a signal, a second of processor time, or more memory than the reader's bound.
"""

from __future__ import annotations

import argparse
import collections
import faulthandler
import json
import os
import random
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

from robustness.mutate import mutated
from robustness.readers import READERS

from jetnormal.errors import JetnormalError, ResourceError

SLOW = 1.0  # seconds of processor time that an input may take
STUCK = 120.0  # seconds without a word, after which a child is ended
FAULTS = ("raised", "killed", "slow", "stuck", "memory")


def content(seeds: list[bytes], name: str, seed: int, number: int) -> bytes:
    return mutated(seeds, random.Random(f"{name} {seed} {number}"))


def run_child(name: str, seed: int, first: int, count: int) -> None:
    """Read inputs, and say of each on stdout what became of it."""
    warnings.simplefilter("ignore")
    faulthandler.disable()
    reader = READERS[name]
    with tempfile.TemporaryDirectory(prefix="fuzz-") as text:
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
            print(json.dumps({"number": number}), flush=True)
            start = time.process_time()
            outcome, note = _outcome(reader.read, path)
            seconds = time.process_time() - start
            if seconds > SLOW:
                outcome, note = "slow", f"{seconds:.1f} s, then {outcome} {note}"
            print(json.dumps({"number": number, "outcome": outcome, "note": note, "seconds": seconds}), flush=True)


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


def run_reader(name: str, seed: int, count: int, deadline: float) -> dict[str, Any]:
    """Send a reader inputs until there were `count` or the time is over, in as many children as it takes."""
    outcomes: collections.Counter[str] = collections.Counter()
    faults: list[tuple[int, str, str]] = []
    slowest = (0.0, -1)
    number = 0
    while number < count and time.monotonic() < deadline:
        for report in _reports(name, seed, number, count - number, deadline):
            outcomes[report["outcome"]] += 1
            slowest = max(slowest, (report.get("seconds", 0.0), report["number"]))
            if report["outcome"] in FAULTS:
                faults.append((report["number"], report["outcome"], report["note"]))
            number = report["number"] + 1
    return {"name": name, "inputs": sum(outcomes.values()), **outcomes, "slowest": slowest, "faults": faults}


def _reports(name: str, seed: int, first: int, count: int, deadline: float) -> Any:
    command = [sys.executable, "-m", "robustness.fuzz", "--child", name, str(seed), str(first), str(count)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment) as child:
        assert child.stdout is not None and child.stderr is not None
        os.set_blocking(child.stderr.fileno(), False)
        begun = None
        while True:
            ready, _, _ = select.select([child.stdout], [], [], STUCK)
            line = child.stdout.readline() if ready else b""
            if not line or time.monotonic() > deadline:
                child.kill()
                break
            report = json.loads(line)
            begun = None if "outcome" in report else report["number"]
            if "outcome" in report:
                yield report
            child.stderr.read()  # what libraries print must not fill the pipe
        code = child.wait()
    if line:
        return  # the time is over
    if begun is not None:
        how = "stuck" if not ready else "killed"
        note = f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        yield {"number": begun, "outcome": how, "note": note}
    elif code:
        raise SystemExit(f"{name}: the reader fails on valid files (exit code {code})")


def print_table(results: list[dict[str, Any]]) -> None:
    columns = ("inputs", "read", "refused", *FAULTS)
    print("| reader |", " | ".join(columns), "| slowest |")
    print("|---|" + "---|" * (len(columns) + 1))
    for result in results:
        cells = " | ".join(f"{result.get(column, 0):,}" for column in columns)
        print(f"| {result['name']} | {cells} | {result['slowest'][0] * 1000:.0f} ms |")
    for result in results:
        for number, outcome, note in result["faults"][:20]:
            print(f"{result['name']} {number}: {outcome}: {note}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--inputs", type=int, default=10**9, help="of each reader, at most")
    parser.add_argument("--reader", action="append", choices=list(READERS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="write this input of the one reader instead of reading any")
    parser.add_argument("--keep", type=Path, help="file for --only")
    parser.add_argument("--child", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        name, *numbers = options.child
        run_child(name, *map(int, numbers))
        return
    names = [name for name in options.reader or READERS if READERS[name].available]
    if options.only is not None:
        with tempfile.TemporaryDirectory() as folder:
            seeds = READERS[names[0]].seeds(Path(folder))
        options.keep.write_bytes(content(seeds, names[0], options.seed, options.only))
        return
    results = []
    start = time.monotonic()
    for done, name in enumerate(names):  # each gets an equal share of what is left
        share = (start + options.seconds - time.monotonic()) / (len(names) - done)
        results.append(run_reader(name, options.seed, options.inputs, time.monotonic() + share))
        print(f"{name}: {results[-1]['inputs']:,} inputs", file=sys.stderr)
    print_table(results)
    sys.exit(any(result["faults"] for result in results))


if __name__ == "__main__":
    main()
