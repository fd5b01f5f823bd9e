"""The figures of this project on real spectra, measured by its own command and stored with how they were made."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import yaml

from ..core import InputError
from ..core.files import write_atomically
from ..fit.folder import versions
from .run_folder import CONFIG, METRICS


class BenchFailed(RuntimeError):
    """A case did not finish; its command said why."""

    exit_status = 1


@dataclass(frozen=True)
class Case:
    """One measurement.

    Attributes:
        title: for the table.
        arguments: of ``wrf-mi``, without ``--out``.
    """

    title: str
    arguments: tuple[str, ...]


SHORT = ("--set", "steps=3000", "--set", "hold_out=0")
"""The schedule of the blocked split, whose five folds are fitted in turn."""


def _train(*arguments: str) -> tuple[str, ...]:
    return ("train", "rfid-lab", *arguments)


CASES: Mapping[str, Case] = {
    **{
        f"wrf-gs+-official-seed{seed}": Case(
            f"WRF-GS+, authors' split, seed {seed}", _train("--model", "wrf-gs+", "--seed", str(seed))
        )
        for seed in range(3)
    },
    "wrf-gs-official": Case("WRF-GS, authors' split", _train("--model", "wrf-gs")),
    "wrf-gs+-paper": Case("WRF-GS+, L = 9 as the paper", _train("--model", "wrf-gs+", "--preset", "paper")),
    "wrf-gs+-blocked": Case("WRF-GS+, blocked", _train("--model", "wrf-gs+", "--split", "blocked", *SHORT)),
    "wrf-gs-blocked": Case("WRF-GS, blocked", _train("--model", "wrf-gs", "--split", "blocked", *SHORT)),
    "demo": Case("the demo (WRF-GS+, short)", ("demo",)),
}


def bench(names: Sequence[str], out: Path, runs: Path) -> list[dict[str, Any]]:
    """Measure cases one after the other, each as a process of its own, and write the table.

    A case whose run folder is finished is only written down again; one that was stopped goes on.

    Args:
        names: keys of `CASES`.
        out: folder for ``<case>.json`` and the table ``README.md``.
        runs: folder for run folders.

    Returns:
        One dictionary a case, as in its JSON file.

    Raises:
        InputError: an unknown case.
        BenchFailed: a case that did not finish.
    """
    for name in names:
        if name not in CASES:
            raise InputError(f"bench {name}: unknown; choose from {', '.join(CASES)}")
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in names:
        result = _measure(name, runs / name)
        write_atomically(out / f"{name}.json", json.dumps(result, indent=1) + "\n")
        rows.append(result)
        print(f"{name}: {out / name}.json", file=sys.stderr)
    text = "# Figures on rfid-lab\n\nWritten by `wrf-mi bench`. " + NOTE + "\n\n" + table(read_results(out)) + "\n"
    write_atomically(out / "README.md", text)
    return rows


def _measure(name: str, folder: Path) -> dict[str, Any]:
    case = CASES[name]
    arguments = [*case.arguments, "--out", str(folder)]
    if not (folder / METRICS).exists() or not (folder / "bench.json").exists():
        resumed = (folder / CONFIG).exists()
        call = ["train", "--resume", str(folder)] if resumed else arguments
        start = time.perf_counter()
        status = subprocess.run([sys.executable, "-m", "wrf_mi.cli", *call], stdout=subprocess.DEVNULL).returncode
        if status != 0:
            raise BenchFailed(f"bench {name}: `wrf-mi {' '.join(call)}` ended with status {status}")
        # The time of the whole process means something only where it ran in one go.
        wall = None if resumed else time.perf_counter() - start
        # Written when it is measured: the table may be made again elsewhere.
        measured = {"wall_seconds": wall, "date": time.strftime("%Y-%m-%d"), "machine": machine()}
        write_atomically(folder / "bench.json", json.dumps(measured))
    config = yaml.safe_load((folder / CONFIG).read_text())
    return {
        "case": name,
        "title": case.title,
        "command": "wrf-mi " + " ".join(arguments),
        **json.loads((folder / "bench.json").read_text()),
        "versions": config["versions"],
        "metrics": json.loads((folder / METRICS).read_text()),
    }


def machine() -> dict[str, Any]:
    """What this machine is."""
    return {
        "processor": versions()["device"],
        "cores": os.cpu_count(),
        "memory_gb": round(psutil.virtual_memory().total / 1e9),
        "system": f"{platform.system()} {platform.machine()}",
    }


def read_results(out: Path) -> list[dict[str, Any]]:
    """All stored results, in the order of `CASES`."""
    return [json.loads(path.read_text()) for name in CASES if (path := out / f"{name}.json").exists()]


NOTE = (
    "SSIM is scikit-image's, over test rows; *blend* is the inverse-distance blend of the four nearest training "
    "spectra on the same rows; time is training time on the machine named in each JSON file, which also holds the "
    "versions, the date and the command."
)


def table(results: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of results."""
    lines = [
        "| what | SSIM median | mean | p10 | p90 | blend median | steps | training | ms per spectrum | peak memory |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for result in results:
        m = result["metrics"]
        own, blend = m["ssim"], m["reference"]["idw4"]["median"]
        minutes = f"{m['train_seconds'] / 60:.1f} min"
        lines.append(
            f"| {result['title']} | **{own['median']:.3f}** | {own['mean']:.3f} | {own['p10']:.3f} | {own['p90']:.3f} "
            f"| {blend:.3f} | {m['steps']:,} | {minutes} | {m['ms_per_sample']:.1f} | {m['peak_memory_mb']:.0f} MB |"
        )
    return "\n".join(lines)
