"""A view as an object that writes itself as a page and displays itself in notebooks."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ..core import InputError
from ..core.files import write_atomically
from .content import SHOWN_GAUSSIANS, SHOWN_PATHS, STORED_TRANSMITTERS, ViewContent, ViewOptions
from .gather import Source, gather
from .page import page, plotly_js

LARGEST_BYTES = 15_000_000
"""Largest size of a page."""
FRAME_HEIGHT_PX = 640
"""Height of a view in a notebook."""


@dataclass(frozen=True)
class View:
    """A view of a scene, runs and maps.

    Attributes:
        content: what it shows.
    """

    content: ViewContent

    @cached_property
    def html(self) -> str:
        """The page: one HTML document that needs no network.

        Raises:
            InputError: it would be larger than `LARGEST_BYTES`.
        """
        text = page(self.content)
        if (size := len(text.encode())) > LARGEST_BYTES:
            remedy = "lower --transmitters, --gaussians or --paths, or give fewer maps"
            raise InputError(f"view: {size / 1e6:.1f} MB, the limit is {LARGEST_BYTES / 1e6:.0f} MB; {remedy}")
        return text

    @property
    def counts(self) -> dict[str, int]:
        """Number of elements of each layer."""
        return self.content.counts

    def write(self, path: str | Path) -> Path:
        """Write the page atomically.

        Raises:
            InputError: as `html`.
        """
        return write_atomically(Path(path), self.html)

    def _repr_html_(self) -> str:
        """The page in a frame of its own, for notebooks."""
        frame = f"width:100%;height:{FRAME_HEIGHT_PX}px;border:1px solid #ccc"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{frame}" title="wrf_mi view"></iframe>'


def view(
    *sources: Source,
    transmitters: int = STORED_TRANSMITTERS,
    gaussians: int = SHOWN_GAUSSIANS,
    paths: int = SHOWN_PATHS,
    material: str | None = None,
    on_stage: Callable[[str, float], None] = lambda stage, share: None,
    progress: bool = False,
) -> View:
    """Interactive 3D view of a scene, runs and maps.

    In a notebook the result displays itself; ``view(...).write("view.html")`` writes one file that needs no network.

    Args:
        sources: what to show: a run or its folder; a scene by name, folder, Mitsuba XML or mesh, or a
            ``sionna.rt.Scene``; a NetCDF file or Zarr folder of ``wrf-mi map``, or an ``xarray.Dataset`` of that form.
            Each layer is that of the first source that has it; all maps are shown.
        transmitters: number of held-out rows whose observations, Gaussians' signals and paths are stored.
        gaussians: number of Gaussians, the strongest.
        paths: number of paths of each stored transmitter to each receiver, the strongest.
        material: radio material of a bare mesh; None: its surfaces are shown without one.
        on_stage: progress callback: stage and fraction done.
        progress: show a bar on standard error where paths are traced.

    Raises:
        InputError: no source, one that cannot be read, a number out of range, or plotly is not installed.

    >>> import wrf_mi
    >>> wrf_mi.view("laboratory").counts["triangles"] > 0
    True
    """
    options = ViewOptions(transmitters, gaussians, paths)
    if not sources:
        raise InputError("view: nothing to show; give a run folder, a scene or a map")
    plotly_js()  # refused before the work
    return View(gather(sources, options, material, on_stage, progress))
