"""Repeatability: equality of all bits where it is guaranteed, and differences otherwise, between subprocesses."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np

from wrf_mi.backend import find_cuda, find_llvm, init
from wrf_mi.backend.probe import try_cuda, try_llvm
from wrf_mi.datasets.registry import locate
from wrf_mi.synthetic.laboratory import NAME as LABORATORY

from .comparison import Row, line
from .subprocess_job import Arrays, Job, subprocess_job

MEASURED = "rfid-lab"
IMAGE = 1e-5
"""Bound on the largest difference of an image, relative to its largest pixel."""
GRADIENT = 1e-3
"""Bound on the relative difference in norm of a step's gradient, worst group, as in the stress benchmark."""
SCORE = 0.02
"""Bound on the range of the median SSIM after a short fit: rounding makes fits differ as two seeds do."""
REPEATS = 3
BATCHES = (1, 4)
SHORT = ("steps=1000", "holdout_steps_fraction=0", "validate_every=1000", "density.every=250")
SMALL = (
    *("steps=400", "initial.gaussians=60", "density.every=100", "density.start=0", "density.stop=0.8"),
    *("checkpoint_every=100", "validate_every=200"),
)
STOP = 230
"""Step between two checkpoints and two rounds of density control."""
ROWS = 40


def different(one: Arrays, other: Arrays) -> list[str]:
    """Names of arrays that differ in any bit, or that only one of the two has."""

    def content(values: Any) -> Any:
        return None if values is None else (values.dtype, values.shape, values.tobytes())

    return sorted(name for name in {*one, *other} if content(one.get(name)) != content(other.get(name)))


def distance(one: Arrays, other: Arrays) -> dict[str, float]:
    """Relative differences of two steps: ``image``, by its largest pixel; ``gradient``, in norm, of the worst group."""
    found = {"image": 0.0, "gradient": 0.0}
    for name, values in one.items():
        error = values.astype(float) - other[name]
        if name == "image":
            found["image"] = float(np.abs(error).max() / np.abs(values).max())
        elif size := float(np.linalg.norm(values)):
            found["gradient"] = max(found["gradient"], float(np.linalg.norm(error)) / size)
    return found


def _bits_row(what: str, one: Arrays, *others: Arrays) -> Row:
    off = sorted({name for other in others for name in different(one, other)})
    size = sum(values.size for values in one.values())
    return line(what, f"differ: {', '.join(off)}" if off else f"{size:,} numbers, all bits equal", "all bits equal")


def again(dataset: str) -> list[Row]:
    """Rows of all results whose bits are guaranteed to be equal."""
    field = Job("field", dataset, SMALL, deterministic=True)
    whole, repeated, resumed = (subprocess_job(job) for job in (field, field, replace(field, stop=STOP)))
    rows = [
        _bits_row("field, `--deterministic`: model, predictions, `predict`", whole, repeated),
        _bits_row("field, `--deterministic`, stopped and resumed in another process", whole, resumed),
    ]
    jobs = {
        "physics with a mesh": Job("physics", LABORATORY, scene=LABORATORY, n_train=ROWS),
        "physics without a mesh": Job("physics", dataset, n_train=ROWS),
        "ray tracing": Job("traced", LABORATORY, scene=LABORATORY),
    }
    if locate("flat-ble"):
        jobs["physics of signal strengths"] = Job("physics", "flat-ble", n_train=64)
    if locate("newrf-conference"):
        jobs["physics of channels, its mesh made anew"] = Job("channels", "newrf-conference", n_train=100)
    most = max(2, os.cpu_count() or 1)
    for name, job in jobs.items():
        found = [subprocess_job(replace(job, threads=threads)) for threads in (1, most, most)]
        rows.append(_bits_row(f"{name}, on 1 thread and twice on {most}", *found))
    return rows


def apart(dataset: str) -> tuple[list[Row], dict[str, Any]]:
    """Rows of differences without ``--deterministic``, and all scores."""
    most, version = max(2, os.cpu_count() or 1), init().llvm_version
    fit = Job("field", dataset, SHORT)
    ways: dict[str, tuple[Job, Any, int]] = {f"{most} threads": (replace(fit, threads=most), None, REPEATS)}
    ways |= {name: (replace(fit, threads=1), path, 1) for name, path in other_llvms().items()}
    if cuda_works():
        ways["CUDA"] = (replace(fit, backend="cuda"), None, REPEATS)
    first = replace(fit, threads=1)
    here = [subprocess_job(step) for step in _steps(first)]
    scores = {"1 thread": [float(subprocess_job(first)["score"])]}
    rows = []
    for name, (job, llvm, runs) in ways.items():
        pairs = [(one, subprocess_job(s, llvm)) for one, s in zip(here, _steps(job), strict=True) for _ in range(runs)]
        against = f"{name} against 1 thread of LLVM {version}, {len(pairs)} cases"
        for what, bound in (("image", IMAGE), ("gradient", GRADIENT)):
            worst = max(distance(*pair)[what] for pair in pairs)
            rows.append(line(f"{what}, {against}", f"worst {worst:.1e}", f"at most {bound:g}"))
        scores[name] = [float(subprocess_job(job, llvm)["score"]) for _ in range(runs)]
    every = [score for one in scores.values() for score in one]
    listed = "; ".join(f"{name} {', '.join(f'{score:.4f}' for score in one)}" for name, one in scores.items())
    steps = int(SHORT[0].removeprefix("steps="))
    value = f"{max(every) - min(every):.4f} apart: {listed}"
    rows.append(line(f"median SSIM after {steps:,} steps, {dataset}", value, f"at most {SCORE:g}"))
    return rows, {"scores": scores}


def _steps(fit: Job) -> list[Job]:
    """Single steps of a fit, with one image and with several."""
    return [replace(fit, kind="step", settings=(f"batch={count}",)) for count in BATCHES]


def other_llvms() -> dict[str, Any]:
    """Files of usable LLVM libraries of other major versions than this process uses, by name."""
    major = (init().llvm_version or "").split(".")[0]
    found: dict[str, Any] = {}
    for library in find_llvm(ignore_variable=True):
        verdict = try_llvm(library)
        if verdict.usable and verdict.version.split(".")[0] != major:
            found.setdefault(f"LLVM {verdict.version}", library.path)
    return found


def cuda_works() -> bool:
    """Whether there is a GPU to compare with."""
    driver = find_cuda()
    return driver is not None and try_cuda(driver).usable


def main() -> dict[str, Any]:
    """All rows, on measured spectra where they are on this machine, else on the laboratory's."""
    dataset = MEASURED if locate(MEASURED) else LABORATORY
    rows, scores = apart(dataset)
    return {"rows": [*again(dataset), *rows], **scores}
