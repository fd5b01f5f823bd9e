"""Fixtures that several files share; what they need is imported when they are used."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from made_flat import write_flat, write_plain_flat

if TYPE_CHECKING:
    from wrf_mi.core import Record


@pytest.fixture(autouse=True)
def same_threads() -> Iterator[None]:
    """Deterministic fits leave the process on one thread."""
    drjit = sys.modules.get("drjit")
    before = drjit and drjit.thread_count()
    yield
    if before:
        from wrf_mi.backend import set_threads

        set_threads(before)


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
    from wrf_mi.measure import write_spectrum_folder

    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "made-here", one_gateway, bits=16)


@pytest.fixture(scope="session")
def flat_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Signal strengths in a flat of one room."""
    return write_flat(tmp_path_factory.mktemp("data") / "flat")


@pytest.fixture(scope="session")
def plain_flat_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same without headings, with heights that differ and anchors that have names."""
    return write_plain_flat(tmp_path_factory.mktemp("data") / "plain")
