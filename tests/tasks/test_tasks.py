"""Tasks and layouts: their registry, and what is refused."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.core.array_files import write_arrays
from wrf_mi.datasets import layouts
from wrf_mi.tasks import TASKS, instrument_of, require


def record(task: str, shape: tuple[int, ...]) -> Record:
    receiver = Receiver("one", np.zeros(3), np.array([0.0, 0, 0, 1]))
    return Record("made", task, np.ones((2, 3)), (receiver,), np.zeros(shape, np.float32), frequencies_hz=np.ones(1))


def test_tasks_have_their_names_and_unknown_tasks_and_instruments_without_arrays_are_refused() -> None:
    assert {name: task.name for name, task in TASKS.items()} == {name: name for name in TASKS}
    assert set(TASKS) >= {"spectrum", "rssi", "csi"}
    assert len({task.block for task in TASKS.values()}) == len(TASKS)
    with pytest.raises(InputError, match="made: task 'sound'; known are spectrum, rssi, csi"):
        _ = record("sound", (1, 2)).task
    with pytest.raises(InputError, match="made: holds rssi; spectra are needed"):
        require(record("rssi", (1, 2)), "spectrum", why="spectra are needed")
    with pytest.raises(InputError, match="antenna array unknown"):
        instrument_of(record("spectrum", (1, 2, 8, 8)))
    with pytest.raises(InputError, match="antennas' positions unknown"):
        instrument_of(record("csi", (1, 2, 4, 3)))
    assert instrument_of(record("spectrum", (1, 2, 8, 8)).with_array(np.zeros((4, 3)))).carrier_hz == 1


def test_record_has_the_registered_task_of_its_name() -> None:
    strengths = record("rssi", (1, 2))
    assert strengths.task is TASKS["rssi"]
    for same in (pickle.loads(pickle.dumps(strengths)), replace(strengths, name="other")):
        assert same.task is TASKS["rssi"]
    assert replace(strengths, task=TASKS["csi"]).task is TASKS["csi"]


def test_layout_is_recognised_by_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"an empty folder; a data set is a folder with receivers\.csv"):
        layouts.layout_of(tmp_path)
    for layout in layouts.BUILT_IN:
        folder = tmp_path / layout.name
        folder.mkdir()
        name = layout.files[0] if layout.files else f"data{layout.suffixes[0]}"
        if layout.array:
            write_arrays(folder / name, {layout.array: 1})
        else:
            (folder / name).touch()
        assert layouts.layout_of(folder) is layout
        assert callable(layout.read)
