"""What comes out the same again: bit for bit where it is promised, else how far results lie apart.

Every result is computed in a process of its own.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from wrf_mi.backend import find_cuda, find_llvm, init
from wrf_mi.backend.probe import try_cuda, try_llvm
from wrf_mi.datasets.registry import locate
from wrf_mi.synthetic.laboratory import NAME as LABORATORY

from .alone import Arrays, Job, alone

MEASURED = "rfid-lab"
IMAGE = 1e-5
"""Largest difference of one image, relative to its largest grey: sums of some tens of terms in float32."""
GRADIENT = 1e-3
"""Relative difference in norm of one step's gradient, worst group, as numbers under stress are held to."""
SCORE = 0.02
"""Median SSIM after a short fit: a fit carries the last digits on until two fits differ as two seeds do."""
REPEATS = 3
BATCHES = (1, 4)
SHORT = ("steps=1000", "holdout_steps_fraction=0", "validate_every=1000", "density.every=250")
SMALL = (
    *("steps=400", "initial.gaussians=60", "density.every=100", "density.start=0", "density.stop=0.8"),
    *("checkpoint_every=100", "validate_every=200"),
)
STOP = 230
"""Between two checkpoints and two rounds of density control."""
ROWS = 40

Row = dict[str, str]


def different(one: Arrays, other: Arrays) -> list[str]:
    """Names of arrays that differ in any bit, or that one of the two alone has."""

    def content(values: Any) -> tuple[Any, ...]:
        return values.dtype, values.shape, values.tobytes()

    shared = set(one) & set(other)
    return sorted({*(set(one) ^ set(other)), *(name for name in shared if content(one[name]) != content(other[name]))})


def distance(one: Arrays, other: Arrays) -> dict[str, float]:
    """How far a step lies from another: ``image``, by the largest grey; ``gradient``, in norm, of the worst group."""
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
    value = f"differ: {', '.join(off)}" if off else f"{size:,} numbers, all bits equal"
    return {"what": what, "value": value, "asked": "all bits equal"}


def again(dataset: str) -> list[Row]:
    """Everything that is promised bit for bit."""
    field = Job("field", dataset, SMALL, deterministic=True)
    whole, repeated, resumed = (alone(job) for job in (field, field, replace(field, stop=STOP)))
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
        found = [alone(replace(job, threads=threads)) for threads in (1, most, most)]
        rows.append(_bits_row(f"{name}, on 1 thread and twice on {most}", *found))
    return rows


def apart(dataset: str, settings: Sequence[str] = SHORT, repeats: int = REPEATS) -> tuple[list[Row], dict[str, Any]]:
    """How far results lie apart without ``--deterministic``.

    Returns:
        Rows, and all scores by what they were computed with.
    """
    most, own = max(2, os.cpu_count() or 1), init()
    fit = Job("field", dataset, tuple(settings))
    ways: dict[str, tuple[Job, Any, int]] = {f"{most} threads": (replace(fit, threads=most), None, repeats)}
    ways |= {name: (replace(fit, threads=1), path, 1) for name, path in other_llvms().items()}
    if cuda_works():
        ways["CUDA"] = (replace(fit, backend="cuda"), None, repeats)
    first = replace(fit, threads=1)
    here = [alone(step) for step in _steps(first)]
    scores = {"1 thread": [float(alone(first)["score"])]}
    rows = []
    for name, (job, llvm, runs) in ways.items():
        pairs = [(one, alone(s, llvm)) for one, s in zip(here, _steps(job), strict=True) for _ in range(runs)]
        against = f"{name} against 1 thread of LLVM {own.llvm_version}, {len(pairs)} cases"
        for what, bound in (("image", IMAGE), ("gradient", GRADIENT)):
            worst = max(distance(*pair)[what] for pair in pairs)
            rows.append({"what": f"{what}, {against}", "value": f"worst {worst:.1e}", "asked": f"at most {bound:g}"})
        scores[name] = [float(alone(job, llvm)["score"]) for _ in range(runs)]
    of_all = [score for one in scores.values() for score in one]
    listed = "; ".join(f"{name} {', '.join(f'{score:.4f}' for score in one)}" for name, one in scores.items())
    steps = int(settings[0].removeprefix("steps="))
    value = f"{max(of_all) - min(of_all):.4f} apart: {listed}"
    row = {"what": f"median SSIM after {steps:,} steps, {dataset}", "value": value, "asked": f"at most {SCORE:g}"}
    return [*rows, row], {"scores": scores}


def _steps(fit: Job) -> list[Job]:
    """Single steps as of a fit: of one image, and of several at once, which more threads share."""
    return [replace(fit, kind="step", settings=(f"batch={count}",)) for count in BATCHES]


def other_llvms() -> dict[str, Any]:
    """Usable LLVMs of other major versions than this process computes with: name to file."""
    own = (init().llvm_version or "").split(".")[0]
    found: dict[str, Any] = {}
    for library in find_llvm(ignore_variable=True):
        verdict = try_llvm(library)
        if verdict.usable and verdict.version.split(".")[0] != own:
            found.setdefault(f"LLVM {verdict.version}", library.path)
    return found


def cuda_works() -> bool:
    """Whether there is a GPU to compare with."""
    driver = find_cuda()
    return driver is not None and try_cuda(driver).usable


def main() -> dict[str, Any]:
    """All of it: on measured spectra where they are on this machine, else on the laboratory's."""
    dataset = MEASURED if locate(MEASURED) else LABORATORY
    rows, scores = apart(dataset)
    return {"rows": [*again(dataset), *rows], **scores}


__all__ = ["again", "apart", "cuda_works", "different", "distance", "main", "other_llvms"]
