"""Sources of exports: a run, a scene or a data set, recognised by its files or its name; writers of data sets."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from wrf_mi_scenes import scenes

from ...core import InputError, Record
from ...core.files import atomic_folder, write_atomically
from ...datasets import write_ble_folder, write_nerf2_csi, write_spectrum_folder
from ...datasets.layouts import is_data
from ...datasets.record_file import write_record_file
from ...datasets.registry import KNOWN
from ...estimators.ray_tracing import CORRECTED, PATHS
from ...runs.folder import CONFIG
from ...runs.run import Run, open_run
from ...scene.folder import FACTS_FILE
from ...tracing.paths.result import TraceResult, load_trace
from ...tracing.sionna.scenes import MESHES
from .format import DATASET, RUN, SCENE, ExportOptions

PICTURE_DB = 40.0  # range of the pictures of spectra
BITS = 16  # bits of a pixel: 8 would round spectra that are computed or of 16 bits


@dataclass(frozen=True)
class Source:
    """Source of an export."""

    name: str  # as given: a path or a name
    kind: str  # what it is exported as: a run, a scene or a data set

    @property
    def run(self) -> Run:
        """The run; its data set is not read."""
        return open_run(self.name)

    def record(self, progress: bool) -> Record:
        """The data set, traced here where it is a synthetic one."""
        from ...synthetic import load_record

        return load_record(self.name, progress=progress)

    def trace(self) -> TraceResult:
        """The stored paths of a run; `InputError`: a run that stores none."""
        path = Path(self.name) / PATHS
        if not path.exists():
            text = f"{self.name}: a run of {self.run.config.model} that stores no paths"
            raise InputError(f"{text}; give one made by wrf-mi trace without --calibrate")
        return load_trace(path)

    def scene(self) -> tuple[str, str | None]:
        """Scene file, folder or name, and the material of a bare mesh that a run states; `InputError`: it has none."""
        if self.kind != RUN:
            return self.name, None
        corrected, config = Path(self.name) / CORRECTED, self.run.config
        if corrected.is_dir():
            return str(corrected), None
        if config.scene is None:
            raise InputError(f"{self.name}: a run of {config.model} without a scene; give a scene, or a traced run")
        return config.scene, config.material

    def carrier_hz(self) -> float | None:
        """Carrier of a run's data, Hz: the middle one where rows have several; None for a scene."""
        from ...tasks.conditions import scene_carrier

        return scene_carrier(self.run.problem.record) if self.kind == RUN else None


Write = Callable[[Source, Path, ExportOptions], dict[str, Any]]
"""``write(source, out, options)`` writes a file or folder and returns facts about it, by words for a reader."""


def kinds_of(name: str | Path) -> tuple[str, ...]:
    """Kinds that a source may be of, in the order of preference; `InputError` for neither a path nor a known name.

    A folder is a run if it holds ``config.yaml``, else a scene if it holds ``scene.yml``, else a data set. A file is a
    scene or a data set by its ending.
    """
    path, text = Path(name), str(name)
    if path.is_dir():
        kind = RUN if (path / CONFIG).exists() else SCENE if (path / FACTS_FILE).exists() else DATASET
        return (kind,)
    if path.is_file():
        kinds = {SCENE: path.suffix.lower() in (".xml", *MESHES), DATASET: is_data(path)}
    else:
        kinds = {SCENE: text in scenes(), DATASET: text in {dataset.name for dataset in KNOWN}}
    if not any(kinds.values()):
        scene_names = ", ".join(scenes())
        ways = f"a run folder, a scene (a folder, XML, mesh, or of {scene_names}) or a data set (`wrf-mi data list`)"
        what = "a file of another kind" if path.exists() else "no such file or name"
        raise InputError(f"{name}: {what}; give {ways}")
    return tuple(kind for kind, fits in kinds.items() if fits)


def _written(task: str | None, write: Callable[[Path, Record, bool], object]) -> Write:
    """A `Write` of a layout for data of a task."""

    def write_layout(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
        record = source.record(options.progress)
        if task is not None and record.task.name != task:
            layouts = ", ".join(name for name, of in TASKS_OF.items() if of in (record.task.name, None))
            raise InputError(f"{source.name}: a data set of {record.task}, the layout holds {task}; choose {layouts}")
        write(out, record, options.replace)
        return {"rows": len(record), "receivers": len(record.receivers)}

    return write_layout


TASKS_OF = {"spectra": "spectrum", "ble": "rssi", "nerf2-csi": "csi", "npz": None}
"""Task of the data of each layout; None: any."""
write_spectra = _written("spectrum", lambda out, record, again: write_spectrum_folder(out, record, BITS, again))
write_strengths = _written("rssi", write_ble_folder)
write_channels = _written("csi", write_nerf2_csi)


def write_pictures(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write spectra as PNG of 8 bits, linear in dB (`wrf_mi.apps.exports.source.Write`).

    ``limits.json`` states the level of black and white, 20 log10 of the data's grey; white is the largest one.
    `InputError`: other data, or a folder that exists.
    """
    record = source.record(options.progress)
    if record.task.name != "spectrum":
        raise InputError(f"{source.name}: a data set of {record.task}; format png takes spectra")
    white_db = 20 * np.log10(record.observation.max() or 1.0)
    share = 1 + (20 * np.log10(record.observation.clip(np.finfo(np.float32).tiny)) - white_db) / PICTURE_DB
    with atomic_folder(out, options.replace) as part:
        for receiver, images in zip(record.receivers, np.rint(255 * share.clip(0, 1)).astype(np.uint8), strict=True):
            (part / receiver.name).mkdir()
            for row, image in enumerate(images, start=1):
                Image.fromarray(image).save(part / receiver.name / f"{row:05d}.png")
        limits = {"black_db": float(white_db - PICTURE_DB), "white_db": float(white_db), "black": 0, "white": 255}
        write_atomically(part / "limits.json", json.dumps(limits, indent=1) + "\n")
    return {"spectra": record.observation[..., 0, 0].size, "limits (dB)": f"{limits['black_db']:g} to {white_db:g}"}


write_npz = _written(None, lambda out, record, again: write_record_file(out, record))
