"""Scenes as objects: made from scans or plans, corrected by measurements, edited and traced."""

from __future__ import annotations

import json
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..backend import init
from ..core import AntennaOptions, InputError, Record, Split
from ..core.antenna import AS_STATED
from ..core.settings import setting_texts, with_settings
from ..datasets.splits import single_split
from ..scene.correction_data import FILE
from ..synthetic import load_record
from ..training.session import OnProgress, quiet
from .applications import APPLICATIONS

# What makes, corrects or edits a scene is imported where it is used: it takes a quarter of the start of a training.
if TYPE_CHECKING:
    from ..correction import CorrectionOptions
    from ..scene.edit import Move
    from .run import Run


@dataclass(frozen=True)
class Scene:
    """A scene to trace.

    Scenes that are made without ``out`` lie in a temporary folder, which is removed with the object.

    Attributes:
        folder: scene folder, or name, Mitsuba XML or mesh of one that was opened.

    >>> room = Scene.open("laboratory")
    >>> traced = room.trace("laboratory", n_train=20, settings={"depth": 1})
    >>> traced.predict([[2.2, 3.0, 1.7]]).mean.shape
    (1, 90, 360)
    """

    folder: Path

    @classmethod
    def open(cls, scene: str | Path) -> Scene:
        """A scene by name, folder, Mitsuba XML or mesh, which is read where it is used."""
        return cls(Path(scene))

    @classmethod
    def from_scan(
        cls, points: str | Path | Sequence[str | Path], out: str | Path | None = None, **options: Any
    ) -> Scene:
        """Make a scene from a 3D scan or mesh; options and errors of `wrf_mi.scene.make.make_scene`."""
        from ..scene.make import make_scene

        return cls._made(out, lambda place: make_scene(points, place, **options))

    @classmethod
    def from_plan(cls, plan: str | Path, height_m: float, out: str | Path | None = None, **options: Any) -> Scene:
        """Make a scene from a plan in two dimensions, with walls of a height; options as those of `from_scan`."""
        return cls.from_scan(plan, out, height_m=height_m, **options)

    def correct(
        self,
        data: str | Path | Record,
        out: str | Path | None = None,
        *,
        split: str | Split | None = None,
        n_train: int | float | None = None,
        seed: int = 0,
        settings: Iterable[str] | Mapping[str, Any] | CorrectionOptions = (),
        material: str | None = None,
        antennas: AntennaOptions = AS_STATED,
        deterministic: bool = False,
        replace: bool = False,
        on_progress: OnProgress = quiet,
        progress: bool = False,
    ) -> Scene:
        """The scene with planes and materials fitted to the training rows of measurements.

        Args:
            data: name or folder of a data set, or a loaded record.
            out: scene folder to make.
            split: name of a split, or its rows; None: the data's own, or else all rows.
            n_train: number or fraction of the training rows to use; None: all.
            seed: seed of split and held-out rows.
            settings: what may change, and how: values by name, ``key=value`` texts, or the options; defaults are by the
                kind of measurements.
            material: radio material of a bare mesh.
            antennas: patterns and polarisations that override the data set.
            deterministic: compute on one thread of the CPU, bit-identical from run to run.
            replace: replace an existing folder.
            on_progress: progress callback: stage and fraction done.
            progress: show bars on standard error where data are traced.

        Raises:
            InputError: data or a scene that cannot be used, or a folder that exists.
            BackendError: a deterministic correction in a process that computes on a GPU already.
        """
        if deterministic:  # before anything is read: reading a data set may choose the GPU
            init("llvm", threads=1)
        from ..correction import CorrectionOptions, default_options, write_page
        from ..stages.correct import correct_scene

        def corrected(place: Path) -> None:
            record = data if isinstance(data, Record) else load_record(data, progress)
            record = record.with_antennas(antennas)
            if isinstance(settings, CorrectionOptions):
                options = settings
            else:
                texts = setting_texts(settings) if isinstance(settings, Mapping) else settings
                options = with_settings(default_options(record, n_train), texts)
            rows = split if isinstance(split, Split) else single_split(record, split, seed, n_train)
            APPLICATIONS["warn"](record)
            write_page(correct_scene(self.folder, record, rows, options, material, on_progress), place, replace)

        return self._made(out, corrected, replace)

    @property
    def correction(self) -> dict[str, Any] | None:
        """Facts of the correction that made the scene, as on its page; None: made by no correction."""
        file = self.folder / FILE
        return dict(json.loads(file.read_text(encoding="utf-8"))) if file.is_file() else None

    def edit(self, moves: Sequence[Move] = (), remove: Sequence[str] = (), out: str | Path | None = None) -> Scene:
        """The scene with parts moved or removed; errors of `wrf_mi.scene.edit.edit_scene`."""
        from ..scene.edit import edit_scene

        return self._made(out, lambda place: edit_scene(self.folder, place, moves, remove))

    def trace(self, data: str | Path | Record, out: str | Path | None = None, **options: Any) -> Run:
        """Ray tracing in the scene as a run, scored on the test rows of the data; options of `wrf_mi.train`."""
        from .api import train

        return train(data, "ray-tracing", self, out=out, **options)

    def view(self, *more: Any, **options: Any) -> Any:
        """Interactive 3D view of the scene and of ``more``, such as runs; options of `wrf_mi.apps.viewer.view.view`."""
        return APPLICATIONS["view"](self.folder, *more, **options)

    @classmethod
    def _made(cls, out: str | Path | None, make: Callable[[Path], Any], replace: bool = False) -> Scene:
        """The scene that a function writes into a new folder; `InputError`, before the work: the folder exists."""
        if out is not None:
            if Path(out).exists() and not replace:
                raise InputError(f"{out}: exists; remove it, choose another folder, or replace it")
            make(Path(out))
            return cls(Path(out))
        home = Path(tempfile.mkdtemp(prefix="wrf-mi-"))
        try:
            make(home / "scene")
        except BaseException:
            shutil.rmtree(home)
            raise
        scene = cls(home / "scene")
        weakref.finalize(scene, shutil.rmtree, home, ignore_errors=True)
        return scene
