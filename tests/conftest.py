"""Fixtures that several files share; what they need is imported when they are used."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Before NumPy is loaded, and for child processes: threads of OpenBLAS wait for each other by spinning, and where
# another process has one of the cores, small products take twenty times as long.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import pytest
from made_flat import write_flat, write_plain_flat

from wrf_mi.backend import init

if TYPE_CHECKING:
    from commands import Command
    from playwright.sync_api import Browser

    from wrf_mi.core import Record
    from wrf_mi.parallel import Scheduler

SLOW_NOTEBOOKS = (
    "few_measurements",
    "from_files_to_map",
    "without_measurements",
    "run_as_mitsuba_scene",
    "rssi_and_csi",
)
# Machines are shared: a case may take ten times as long as the one before.
hypothesis.settings.register_profile("shared", deadline=None)
hypothesis.settings.load_profile("shared")
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def pytest_configure(config: pytest.Config) -> None:
    """Choose the backend before a test imports Dr.Jit: a GPU for ``-m gpu`` and ``WRF_MI_TEST_BACKEND=cuda`` alone.

    All other tests compute on the CPU, where bounds of float64 and equal bits hold, and so do their child processes:
    each on its share of the cores, as processes with more threads than cores wait for each other.
    """
    chosen = str(config.option.markexpr)
    on_gpu = ("gpu" in chosen and "not gpu" not in chosen) or os.environ.get("WRF_MI_TEST_BACKEND") == "cuda"
    if not on_gpu:
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    if workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "0")):
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, CORES // workers)))
    init()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the notebooks that take minutes as slow tests."""
    for item in items:
        if item.path.suffix == ".ipynb" and item.path.stem in SLOW_NOTEBOOKS:
            item.add_marker("slow")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Set Dr.Jit's threads to this process's share of the cores, or to all cores where a test is marked so.

    This precedes each test and its fixtures, as deterministic fits leave the process on one thread. Runs time one
    single prediction instead of twenty.
    """
    evaluate: Any = sys.modules.get("wrf_mi.runs.evaluate")
    if evaluate:
        evaluate.REPEATS = 1
    if "drjit" in sys.modules:
        from wrf_mi.backend import set_threads

        workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
        set_threads(max(2, CORES) if item.get_closest_marker("all_threads") else max(1, CORES // workers))


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """The command within this process."""
    from commands import Command

    return Command(capsys)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparisons write a grey image in place of each picture, which takes half a second to draw."""
    from PIL import Image

    grey = Image.new("L", (4, 3))
    monkeypatch.setattr("wrf_mi.runs.compare.write_figure", lambda path, figure: grey.save(path, format="png"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium; for a module, as its client keeps an event loop running in which no other can run."""
    from pages import started

    with started() as running:
        yield running


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of targets, transmitters where rays leave the receivers, of each search for paths in a test."""
    from wrf_mi.tracing.paths import solve

    counts, search = list[int](), solve._search

    def counted(shared: Any, sources: Any, targets: Any, *arguments: Any) -> Any:
        counts.append(len(targets))
        return search(shared, sources, targets, *arguments)

    monkeypatch.setattr(solve, "_search", counted)
    return counts


@pytest.fixture(scope="session")
def two_gateways() -> Record:
    """Spectra [2, 24, 20, 40] of two receivers, see `made_spectra`."""
    from made_spectra import spectra

    return spectra(receivers=2)[0]


@pytest.fixture(scope="session")
def one_gateway(two_gateways: Record) -> Record:
    """The same at the first receiver alone."""
    return replace(two_gateways, receivers=two_gateways.receivers[:1], observation=two_gateways.observation[:1])


@pytest.fixture(scope="session")
def folder(one_gateway: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same as a data set."""
    from wrf_mi.datasets import write_spectrum_folder

    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "made-here", one_gateway, bits=16)


@pytest.fixture(scope="session")
def flat_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Signal strengths in a flat of one room."""
    return write_flat(tmp_path_factory.mktemp("data") / "flat")


@pytest.fixture(scope="session")
def room(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flat's plan, extruded: concrete and boards, whose conductivity goes with frequency."""
    from wrf_mi.scene.make import make_scene

    return make_scene(flat_folder / "layout.csv", tmp_path_factory.mktemp("scenes") / "room", height_m=2.7).folder


@pytest.fixture(scope="session")
def plain_flat_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without headings, with heights that differ and anchors that have names."""
    return write_plain_flat(tmp_path_factory.mktemp("data") / "plain")


@pytest.fixture(scope="module")
def two() -> Iterator[Scheduler]:
    """Two workers on this machine."""
    from wrf_mi.parallel import open_scheduler

    with open_scheduler("local:2") as workers:
        yield workers


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Time [s] of `wrf_mi_bench.timing`, which calls advance."""
    from wrf_mi_bench import timing

    now = [0.0]
    monkeypatch.setattr(timing.time, "perf_counter", lambda: now[0])
    return now
