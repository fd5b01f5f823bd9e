"""Differences of images, gradients and metrics between numbers of threads, LLVM libraries, NumPy versions and devices.

Each variant is computed in a child process by `wrf_mi_bench.elsewhere_job`, and compared with the first: one thread of
the LLVM and NumPy of this process. LLVM libraries are those that `wrf_mi.backend.find_llvm` finds and that work; other
versions of NumPy are folders in the environment variable `NUMPY_FOLDERS`, made by ``pip install --target``.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend import choose, find_cuda, find_llvm
from wrf_mi.backend.libraries import LLVM_VARIABLE
from wrf_mi.backend.probe import try_cuda, try_llvm

from .bench import BenchFailed
from .declared import pivoted

NUMPY_FOLDERS = "WRF_MI_NUMPY_FOLDERS"
THREADS = (1, 2, 4, 8)
JOB = "wrf_mi_bench.elsewhere_job"
GRADIENT = "gradient/"
BOUNDS = {"image": 1e-5, "traced": 1e-5, "gradient": 1e-3, "metrics": 0.02}
"""Bounds by quantity: 1e-5 of the largest value of an image, whose sums of some hundred terms are rounded in other
orders, or with a product and a sum contracted (FMA); 1e-3 in norm of a gradient, as in the stress benchmark; metrics of
a fit as between two seeds."""
EXACT = ("image", "traced", "metrics")
"""Quantities that are bit-identical on any number of threads: pixels are sums of one thread each, a deterministic fit
has one thread."""
HEADS = {"image": "image of Gaussians", "traced": "traced spectrum"}
HEADS |= {"gradient": "gradients", "metrics": "metrics of a fit"}

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class Variant:
    """A child process: kind (``threads``, ``llvm``, ``numpy`` or ``cuda``), backend, threads, environment variables."""

    kind: str
    backend: str = "llvm"
    threads: int = 1
    environment: Mapping[str, str] = field(default_factory=dict)


def variants(threads: Sequence[int] = THREADS) -> Iterator[Variant]:
    """The first to compare with, then all others that this machine has."""
    used = choose("llvm")
    same = {LLVM_VARIABLE: used.llvm_path or ""}
    for count in threads:
        yield Variant("threads", threads=count, environment=same)
    listed_versions = {used.llvm_version}
    for library in find_llvm(ignore_variable=True):
        verdict = try_llvm(library)
        if verdict.usable and verdict.version not in listed_versions:
            listed_versions.add(verdict.version)
            yield Variant("llvm", environment={LLVM_VARIABLE: str(library.path)})
    for folder in filter(None, os.environ.get(NUMPY_FOLDERS, "").split(os.pathsep)):
        yield Variant("numpy", environment={**same, "PYTHONPATH": folder})
    if (driver := find_cuda()) is not None and try_cuda(driver).usable:
        yield Variant("cuda", backend="cuda")


def computed(variant: Variant, small: bool) -> tuple[Arrays, dict[str, str]]:
    """Arrays and versions of a variant; `BenchFailed` where its process fails."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arrays.npz"
        call = [sys.executable, "-m", JOB, str(file), variant.backend, str(variant.threads), str(int(small))]
        # Child processes find the packages as this one does, after those that the variant puts first.
        paths = os.pathsep.join([variant.environment.get("PYTHONPATH", ""), *sys.path]).strip(os.pathsep)
        environment = {**os.environ, **variant.environment, "PYTHONPATH": paths}
        done = subprocess.run(call, env=environment, capture_output=True, text=True)
        if done.returncode != 0:
            raise BenchFailed(f"bench elsewhere: {variant}: {done.stderr.strip().rpartition(chr(10))[2]}")
        with np.load(file) as arrays:
            values = dict(arrays)
    return values, json.loads(str(values.pop("versions")))


def differences(first: Arrays, other: Arrays) -> dict[str, float]:
    """Largest differences by quantity, relative except for metrics; quantities that both have."""
    changes: dict[str, float] = {}
    for name in ("image", "traced", "metrics"):
        if name in first and name in other:
            largest = 1.0 if name == "metrics" else float(np.abs(first[name]).max())
            changes[name] = float(np.abs(first[name] - other[name]).max() / largest)
    norms = [(first[name], other[name]) for name in first if name.startswith(GRADIENT)]
    changes["gradient"] = max(float(np.linalg.norm(a - b) / np.linalg.norm(a)) for a, b in norms if np.any(a))
    return changes


def main(threads: Sequence[int] = THREADS, small: bool = False) -> dict[str, Any]:
    """Differences of all variants from the first."""
    rows: list[dict[str, Any]] = []
    first: tuple[Arrays, str] | None = None
    for variant in variants(threads):
        arrays, versions = computed(variant, small)
        if first is None:
            first = arrays, f"1 thread, LLVM {versions['llvm']}, NumPy {versions['numpy']}"
            continue
        name = {
            "threads": f"{variant.threads} threads",
            "llvm": f"LLVM {versions['llvm']}",
            "numpy": f"NumPy {versions['numpy']}",
            "cuda": f"CUDA, {versions['device']}",
        }[variant.kind]
        for quantity, value in differences(first[0], arrays).items():
            bound = 0.0 if variant.kind == "threads" and quantity in EXACT else BOUNDS[quantity]
            asked = f"at most {bound:g}" if bound else "bit-identical"
            row = {"what": f"{name}: {HEADS[quantity]}", "value": f"{value:.1e}" if value else "0", "asked": asked}
            row |= {"variant": name, "compared_with": first[1], "quantity": quantity}
            rows.append({**row, "difference": value, "bound": bound})
    above = [row["what"] for row in rows if not row["difference"] <= row["bound"]]
    return {"rows": rows} | ({"failed": f"beyond its bound: {'; '.join(above)}"} if above else {})


table = pivoted(
    "| against {compared_with} | ... |",
    "| {variant} | ... |",
    "variant",
    "quantity",
    "**{value}** ({asked})",
    titles=HEADS,
)
"""A line for each variant, difference and promise of each quantity."""
