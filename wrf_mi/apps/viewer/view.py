"""A view as an object that writes itself as a page and displays itself in notebooks."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes import scenes

from ...core import InputError, Record
from ...core.angles import FloatArray
from ...core.files import write_atomically
from ...core.types import IntArray
from ...runs.folder import CONFIG
from ...runs.results import read_run
from ...runs.run import Run, open_run
from ...tasks.conditions import scene_carrier
from . import layers
from .content import SHOWN_GAUSSIANS, SHOWN_PATHS, STORED_TRANSMITTERS, ViewContent, ViewOptions
from .map_layer import SUFFIXES, read_map, thinned
from .page import page, plotly_js

Source = str | Path | Run | Any
"""A run, its folder, a scene by name, folder or file, a ``sionna.rt.Scene``, a map file or an ``xarray.Dataset``."""

LARGEST_BYTES = 15_000_000  # largest size of a page
FRAME_HEIGHT_PX = 640  # height of a view in a notebook


@dataclass(frozen=True)
class View:
    """A view of a scene, runs and maps."""

    content: ViewContent  # what it shows

    @cached_property
    def html(self) -> str:
        """The page: one HTML document that needs no network; `InputError`: it would be larger than `LARGEST_BYTES`."""
        text = page(self.content)
        if (size := len(text.encode())) > LARGEST_BYTES:
            remedy = "lower --max-transmitters, --max-gaussians or --max-paths, or give fewer maps"
            raise InputError(f"view: {size / 1e6:.1f} MB, the limit is {LARGEST_BYTES / 1e6:.0f} MB; {remedy}")
        return text

    @property
    def counts(self) -> dict[str, int]:
        """Number of elements of each layer."""
        return self.content.counts

    def write(self, path: str | Path) -> Path:
        """Write the page atomically; `InputError`: as `html`."""
        return write_atomically(Path(path), self.html)

    def _repr_html_(self) -> str:
        """The page in a frame of its own, for notebooks."""
        frame = f"width:100%;height:{FRAME_HEIGHT_PX}px;border:1px solid #ccc"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{frame}" title="wrf_mi view"></iframe>'


@dataclass
class _Gathered:
    """What is known of a view, source by source."""

    options: ViewOptions
    material: str | None
    on_stage: layers.OnStage
    progress: bool
    content: ViewContent = field(default_factory=lambda: ViewContent(""))
    titles: list[str] = field(default_factory=list)
    scenes: list[tuple[Any, dict[str, layers.Look]]] = field(default_factory=list)  # the first is shown
    material_used: bool = False

    def add(self, source: Source) -> None:
        """Add a source, by its kind."""
        if isinstance(source, Run):
            self._add_run(source)
        elif hasattr(source, "data_vars"):
            self._add_map(source)
        elif hasattr(source, "mi_scene"):
            self.titles.append("scene")
            self.scenes.append(layers.surfaces_in(source))
        elif not Path(source).exists() and str(source) not in scenes():
            names = ", ".join(scenes())
            raise InputError(f"{source}: no such file; give a run folder, a map or a scene (or its name: {names})")
        elif (Path(source) / CONFIG).is_file():
            self._add_run(open_run(source))
        elif Path(source).suffix.lower() in SUFFIXES:
            self._add_map(source)
        else:
            self.on_stage("opening the scene", 0.0)
            self.titles.append(Path(source).name)
            self.scenes.append(layers.read_scene(source, self.material))
            self.material_used = True

    def _add_map(self, source: Any) -> None:
        content, notes = read_map(source)
        self.content.maps.append(content)
        self.content.notes += notes
        self.titles.append(content.name)

    def _add_run(self, run: Run) -> None:
        """Add what a run has and no earlier one: rows, scene, Gaussians, paths."""
        content, results, record = self.content, read_run(run.folder), run.problem.record
        self.titles.append(f"{results.name}: {run.config.model} on {record.name}")
        first = content.rows is None
        if first:
            content.receivers = results.receivers
            content.receivers_m = np.stack([receiver.position_m for receiver in record.receivers])
            content.rows, notes = layers.rows_content(results, self.options)
            content.notes += notes
        scene = None
        if run.config.scene is not None:
            self.on_stage("opening the scene", 0.0)
            scene = layers.run_scene(run, scene_carrier(record))
            self.scenes.append(layers.surfaces_in(scene))
        if content.rows is None:
            return
        stored = content.rows.stored
        numbers, positions = content.rows.row[stored], content.rows.tx_pos_m[stored]
        if not first and not _has_rows(record, content.receivers, numbers, positions):
            content.notes.append(f"{results.name}: of other data than the first run; only its scene is shown.")
            return
        if content.gaussians is None:
            content.gaussians, notes = layers.gaussians_content(run, positions, self.options, self.on_stage)
            content.notes += notes
        if content.paths is None:
            self._add_paths(run, numbers, positions, scene)

    def _add_paths(self, run: Run, numbers: IntArray, positions: FloatArray, scene: Any) -> None:
        limits = self.options, self.on_stage, self.progress
        try:
            self.content.paths, notes = layers.paths_content(run, numbers, positions, scene, *limits)
        except InputError as error:  # a transmitter inside a solid, for example, hides paths but nothing else
            notes = [f"Paths: not traced, {error}"]
        self.content.notes += notes

    def finished(self) -> ViewContent:
        """Content of all sources; `InputError`: there is nothing to show."""
        content = self.content
        if self.scenes:
            content.scene, note = layers.scene_content(*self.scenes[0])
            content.notes += [note] if note else []
        content.maps, notes = thinned(content.maps)
        content.notes += notes
        content.title = "; ".join(self.titles)
        if not content.receivers:
            content.receivers = tuple(dict.fromkeys(name for shown in content.maps for name in shown.receivers))
            content.receivers_m = np.full((len(content.receivers), 3), np.nan)
        if content.scene is None and content.rows is None and not content.maps:
            raise InputError(f"{content.title}: neither scene nor positions are known; there is nothing to show")
        return content


def _has_rows(record: Record, receivers: Sequence[str], rows: IntArray, positions_m: FloatArray) -> bool:
    """Whether a record has these receivers, and these positions [t, 3] in its rows."""
    same = [receiver.name for receiver in record.receivers] == list(receivers)
    return same and rows.max() < len(record) and np.array_equal(record.tx_pos_m[rows], positions_m)


def view(
    *sources: Source,
    transmitters: int = STORED_TRANSMITTERS,
    gaussians: int = SHOWN_GAUSSIANS,
    paths: int = SHOWN_PATHS,
    material: str | None = None,
    on_progress: Callable[[str, float], None] = lambda stage, share: None,
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
        on_progress: progress callback: stage and fraction done.
        progress: show a bar on standard error where paths are traced.

    Raises:
        InputError: no source, one that cannot be read, a number out of range, or plotly is not installed.

    >>> from wrf_mi.apps.viewer.view import view
    >>> view("laboratory").counts["triangles"] > 0
    True
    """
    options = ViewOptions(transmitters, gaussians, paths)
    if not sources:
        raise InputError("view: nothing to show; give a run folder, a scene or a map")
    plotly_js()  # refused before the work
    gathered = _Gathered(options, material, on_progress, progress)
    for source in sources:
        gathered.add(source)
    if material is not None and not gathered.material_used:
        raise InputError(f"material {material}: of a bare mesh, and no source is one; omit it")
    return View(gathered.finished())
