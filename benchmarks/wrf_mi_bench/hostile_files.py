"""Damaged and hostile files: every reader is given changed files and has to refuse them in one line, or to read them.

The readers run in a child process (``python -m wrf_mi_bench.hostile_files FOLDER READER FIRST COUNT``), which may crash
or hang without harm; it goes on with the next input. Inputs follow from their number: each can be made again.
"""

import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import psutil

from wrf_mi.core import InputError
from wrf_mi.core.files import append_line, one_line, write_atomically

from .bench import BenchFailed

HANG_S = 10.0  # time after which an input counts as a hang
START_S = 180.0  # time for a child to start and to compile its first kernels
MEMORY_BYTES = 3 << 30
"""Address space that readers may take beyond that of the process: Python raises `MemoryError` past it."""
LARGEST_TEXT = 300  # characters of a message
STATE, RESULTS, SAMPLES, WORK = "state", "results.jsonl", "samples", "work"
NUMBERS = (0, -1, 1, 255, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1)
TEXTS = (
    *(b"0", b"-1", b"1e308", b"nan", b"inf", b"100000", b"9999999999", b"1" * 5000, b"..", b"/etc/passwd", b"null"),
    *(b"[]", b"{}", b"[1, 2]", b"{a: 1}", b"true", b"*a", b"&a", b"\xff\xfe", b"\0", b"\n\n", b"'", b'"', b"<!ENTITY>"),
    *(b"!!python/object:os.system", b"2024-99-99", b"1:1:1", b"<<: *a", b"element vertex 99999999999"),
)
"""Pieces that replace numbers and words."""
WORD = re.compile(rb"[\w.+-]+")


def mutated(content: bytes, number: int, name: str) -> bytes:
    """The content of a file with one to four changes, drawn for the number of the input and the reader."""
    rng = random.Random(f"{name} {number}")
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        at = rng.randrange(len(data)) if data else 0
        size = min(rng.choice((1, 2, 4, 8, 64)), len(data) - at)
        match rng.randrange(8):
            case 0 if data:
                data[at] ^= 1 << rng.randrange(8)
            case 1:
                data[at : at + size] = rng.randbytes(size)
            case 2:
                del data[at:]
            case 3:
                del data[at : at + size]
            case 4:
                data[at:at] = data[at : at + size] * rng.choice((1, 2, 50))
            case 5:
                wide = rng.choice((4, 8))
                number_of_file = rng.choice(NUMBERS) % (1 << 8 * wide)
                data[at : at + wide] = number_of_file.to_bytes(wide, rng.choice(("little", "big")))
            case 6 | 7 if words := list(WORD.finditer(bytes(data[at : at + 4096]))):
                word = rng.choice(words)
                data[at + word.start() : at + word.end()] = rng.choice(TEXTS)
    return bytes(data)


def run_readers(folder: Path, names: Sequence[str], count: int) -> list[dict[str, Any]]:
    """Give each reader (`wrf_mi_bench.hostile_samples.READERS`) ``count`` inputs, in child processes.

    Samples and results in ``folder`` are used again. Each reader has ``reader``, ``inputs``, ``refused``, ``loaded``,
    ``failed`` (messages by number of the input), ``slowest_s`` and ``largest_mb``, growth of the resident memory by one
    input.
    """
    from .hostile_samples import prepare

    prepare(folder / SAMPLES)
    (folder / RESULTS).unlink(missing_ok=True)
    failures: dict[str, dict[int, str]] = {name: {} for name in names}
    place, first = 0, 0
    while place < len(names):
        write_atomically(folder / STATE, json.dumps(asdict(Tally(names[place], first))))
        shutil.rmtree(folder / WORK, ignore_errors=True)
        call = [sys.executable, "-m", __name__ if __name__ != "__main__" else "wrf_mi_bench.hostile_files"]
        call += [str(folder), ",".join(names[place:]), str(first), str(count)]
        with (folder / "errors.txt").open("w") as errors:
            child = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=errors)
            reason = _watched(child, folder / STATE)
        if reason is None:
            break
        last = (folder / STATE).read_text()
        # A child that ends before its first input would do so again, once for each input.
        if not (folder / WORK).exists():
            error = "".join((folder / "errors.txt").read_text().splitlines()[-1:])
            raise BenchFailed(f"readers of changed files: {reason}, before the first input: {error}")
        append_line(folder / RESULTS, last)
        name, number = json.loads(last)["reader"], json.loads(last)["number"]
        failures[name][number] = reason
        place, first = names.index(name), number + 1
    tallies: dict[str, dict[str, Any]] = {}
    for text in (folder / RESULTS).read_text().splitlines() if (folder / RESULTS).exists() else ():
        tally = json.loads(text)
        del tally["number"]
        total = tallies.setdefault(tally["reader"], tally)
        if total is not tally:
            total["failed"] |= tally["failed"]
            total |= {key: total[key] + tally[key] for key in ("refused", "loaded")}
            total |= {key: max(total[key], tally[key]) for key in ("slowest_s", "largest_mb")}
    rows = []
    for name in names:
        failed = tallies[name]["failed"] | {str(number): reason for number, reason in failures[name].items()}
        rows.append({**tallies[name], "inputs": count, "failed": failed})
    return rows


@dataclass
class Tally:
    """Results of a reader before the input of a number."""

    reader: str
    number: int
    refused: int = 0
    loaded: int = 0
    failed: dict[str, str] = field(default_factory=dict)  # messages by number of the input
    slowest_s: float = 0.0
    largest_mb: float = 0.0  # growth of the resident memory by one input


def _watched(child: subprocess.Popen[bytes], state: Path) -> str | None:
    """Wait for a child; the reason why it ended in an input, or None."""
    last, since, started = "", time.monotonic(), False
    while child.poll() is None:
        time.sleep(0.2)
        now = state.read_text()
        if now != last:
            started = started or last != ""
            last, since = now, time.monotonic()
        elif time.monotonic() - since > (HANG_S if started else START_S):
            child.kill()
            child.wait()
            return f"took more than {HANG_S:g} s"
    return None if child.returncode == 0 else f"the process ended with status {child.returncode}"


def forked_module(
    module: str, arguments: Sequence[str], quiet: bool | None = None, most_s: float | None = None
) -> tuple[int, str]:
    """`wrf_mi.parallel.run_module` by a fork of this process: a thousand starts of Python would take half an hour."""
    with tempfile.TemporaryFile("w+", errors="replace") as errors:
        child = os.fork()
        if not child:
            status = 1
            try:
                os.dup2(errors.fileno(), 2)
                status = import_module(module).main(*arguments)
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(status)
        until = time.monotonic() + (most_s or HANG_S)
        while not (waited := os.waitpid(child, os.WNOHANG))[0]:
            time.sleep(0.001)
            if time.monotonic() > until:
                os.kill(child, signal.SIGKILL)
        errors.seek(0)
        lines = [line.strip() for line in errors if line.strip()]
    return os.waitstatus_to_exitcode(waited[1]), lines[-1] if lines else ""


def _read_one(reader: Any, sample: Path) -> str | None:
    """None where it loads, "" where it is refused in one line, else what went wrong."""
    try:
        reader.read(sample)
    except InputError as error:
        text = str(error)
        return "" if "\n" not in text and len(text) < 2000 else f"more than one line: {text[:LARGEST_TEXT]}"
    except BaseException as error:  # the point of the measurement
        if isinstance(error, KeyboardInterrupt):
            raise
        return f"{type(error).__name__}: {one_line(error)[:LARGEST_TEXT]}"
    return None


def main(folder: str, names: str, first: str, count: str) -> None:
    """Read changed files; the state before each input, and results, are files in the folder."""
    import logging

    from .hostile_samples import READERS, warm

    logging.disable(logging.CRITICAL)
    place = Path(folder)
    warm()
    most = psutil.Process().memory_info().vms + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    for user in ("wrf_mi.scene.scan.points", "wrf_mi.datasets.read_mat", "wrf_mi.apps.viewer.map_layer"):
        mock.patch.object(import_module(user), "run_module", forked_module).start()
    start = int(first)
    for name in names.split(","):
        reader, work, tally = READERS[name], place / WORK, Tally(name, start)
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(place / SAMPLES / reader.group, work)
        content = (work / reader.file).read_bytes()
        if (wrong := _read_one(reader, work)) is not None:
            tally.failed["whole"] = f"the whole file is not read: {wrong}"
        for number in range(start, int(count)):
            tally.number = number
            write_atomically(place / STATE, json.dumps(asdict(tally)))
            (work / reader.file).write_bytes(mutated(content, number, name))
            before, peak = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            wrong = _read_one(reader, work)
            tally.slowest_s = max(tally.slowest_s, time.perf_counter() - before)
            growth_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) / 1e3
            tally.largest_mb = max(tally.largest_mb, growth_mb)
            tally.refused, tally.loaded = tally.refused + (wrong == ""), tally.loaded + (wrong is None)
            if wrong:
                tally.failed[str(number)] = wrong
        append_line(place / RESULTS, json.dumps(asdict(tally) | {"number": int(count)}))
        start = 0
    shutil.rmtree(place / WORK, ignore_errors=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
