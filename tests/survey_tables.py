"""Tables of surveys that tests write and import."""

from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi import import_measurements
from wrf_mi.apps.importing import ImportReport
from wrf_mi.core import Record


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


def imported(tmp_path: Path, file: Path, **options: Any) -> ImportReport:
    return import_measurements(file, tmp_path / "data", replace=True, **options)


def strengths(record: Record) -> dict[str, dict[tuple[float, float], float]]:
    """Strengths of the receivers by the position of the row, those that nothing received left out."""
    places = [(round(float(x), 3) + 0.0, round(float(y), 3) + 0.0) for x, y in record.tx_pos_m[:, :2]]
    return {
        receiver.name: {place: float(dbm) for place, dbm in zip(places, row, strict=True) if np.isfinite(dbm)}
        for receiver, row in zip(record.receivers, record.observation, strict=True)
    }


def has_note(report: ImportReport, text: str) -> bool:
    return any(text in note for note in report.notes)
