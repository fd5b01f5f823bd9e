"""Outputs of the test scripts of NeRF2 and WRF-GS+, as arrays of predictions.

| output | script | content |
| --- | --- | --- |
| folder of `0.png`, `1.png`, ... | both, spectra | polar plots of prediction and measurement side by side |
| `result.txt` | NeRF2, signal strengths | lines ``measured, predicted``, dBm, of the receivers that received each row |
| `result.mat` | NeRF2, channels | ``pred_csi`` and ``gt_csi`` [m, antennas, subcarriers] |

Predictions are in the order of ``test_index.txt``. The measurement beside each is compared with the data set's, so that
predictions of other data, or in another order, are refused. Folders may also hold grey pictures of predicted spectra,
numbered as the plots or named as the data set's ``spectrum/00001.png``.

Sources: ``nerf2_runner.py`` and ``utils/data_painter.py`` of https://github.com/XPengZhao/NeRF2 (2023), ``train.py``
and ``utils/data_painter.py`` of https://github.com/wenchaozheng/WRF-GS (2024) and .../WRF-GSplus (2025).
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from ..core import DataFault, InputError, Record
from ..core.files import one_line, readable, text_lines
from ..core.pictures import PICTURE_ERRORS, open_picture
from ..core.types import FloatArray, IntArray
from ..datasets.observations import place_of
from ..datasets.read_mat import FAULT, mat_arrays
from ..datasets.spectrum_folder import read_grey
from ..receivers.scaling import minmax_scale

logger = logging.getLogger(__name__)

COLOUR_MAPS = ("viridis", "jet")  # of WRF-GS+ and of NeRF2
SAME_COLOUR = 2  # largest difference of a channel, of 255, from a colour of the map: rounding of Matplotlib's versions
MOST_PIXELS = 1 << 24  # largest plot that is read; those of the scripts have 2850 x 1328 pixels
SAME_SPECTRUM = 0.01  # mean difference of grey values; drawing and reading a spectrum of 90 x 360 pixels leaves 0.0005
SAME_STRENGTH_DB = 0.02  # two decimals are written, of single-precision amplitudes
SAME_CHANNEL = 1e-3  # relative to the largest coefficient, by which the scripts divide in single precision
REMEDY = "give the data set whose test_index.txt the script read"


def read_released(path: Path, record: Record) -> dict[str, NDArray[Any]]:
    """Arrays ``prediction`` [n_rx, m, ...] and ``row`` [m] of an output of NeRF2's or WRF-GS+'s test script.

    Raises:
        InputError: an output of another kind than the record, incomplete or damaged, or of other measurements.
    """
    kind, read = {".txt": ("rssi", _read_strengths), ".mat": ("csi", _read_channels)}.get(
        path.suffix.lower() if not path.is_dir() else "", ("spectrum", _read_spectra)
    )
    if record.task.name != kind:
        raise InputError(f"{path}: outputs of this form hold {kind}, {record.name} {record.task}; give .npz")
    if record.official is None:
        raise InputError(f"{path}: {place_of(record)} has no test_index.txt, whose order outputs have; give .npz")
    return read(path, record, record.official[1])


def _refuse_other(path: Path, record: Record, rows: IntArray, difference: FloatArray, most: float, unit: str) -> None:
    """Refuse predictions whose measurements of some rows differ from the record's by more than ``most``."""
    wrong = np.flatnonzero(~(difference <= most))
    if len(wrong):
        text = (
            f"its measurement of row {rows[wrong[0]]} differs by {difference[wrong[0]]:.2g}{unit} from {record.name}'s"
        )
        raise InputError(f"{path}: {text}; {REMEDY}")


def _pair(path: Path, number: int, line: str) -> list[float]:
    try:
        measured, predicted = map(float, line.split(","))
    except ValueError:
        raise DataFault(path, f"{line[:40]!r} is not measured, predicted in dBm; correct it", line=number) from None
    return [measured, predicted]


def _read_strengths(path: Path, record: Record, test: IntArray) -> dict[str, NDArray[Any]]:
    pairs = np.array([_pair(path, number, line) for number, line in enumerate(text_lines(path), 1)]).reshape(-1, 2)
    observed = record.observation[:, test].T  # receivers fastest, as in the file
    received = np.isfinite(observed)
    if len(pairs) != received.sum():
        text = f"{len(pairs)} lines, but {record.name} has {received.sum()} strengths in its {len(test)} test rows"
        raise InputError(f"{path}: {text}; {REMEDY}")
    difference = np.abs(pairs[:, 0] - observed[received])
    _refuse_other(path, record, test[np.nonzero(received)[0]], difference, SAME_STRENGTH_DB, " dB")
    prediction = np.full(received.shape, np.nan)
    prediction[received] = pairs[:, 1]
    return {"prediction": prediction.T, "row": test}


def _read_channels(path: Path, record: Record, test: IntArray) -> dict[str, NDArray[Any]]:
    with readable(path, f"{path}: no such file; give result.mat", "run the test script again"):
        arrays = mat_arrays(dict.fromkeys(("pred_csi", "gt_csi"), path), "run the test script again")
        if faults := [str(text) for key, text in arrays.items() if key.startswith(FAULT)]:
            raise ValueError(faults[0])
    observed = record.observation[0, test]
    for key in ("pred_csi", "gt_csi"):
        if key not in arrays or arrays[key].shape != observed.shape:
            what = f"has shape {list(arrays[key].shape)}" if key in arrays else "is missing"
            raise InputError(
                f"{path}: {key} {what}, {record.name} has {list(observed.shape)} in its test rows; {REMEDY}"
            )
    largest = np.nanmax(np.abs(record.observation))
    difference = np.abs(arrays["gt_csi"] - observed).reshape(len(test), -1).max(axis=1) / largest
    _refuse_other(path, record, test, difference, SAME_CHANNEL, " of the largest coefficient")
    return {"prediction": arrays["pred_csi"][None], "row": test}


def _read_spectra(folder: Path, record: Record, test: IntArray) -> dict[str, NDArray[Any]]:
    if len(record.receivers) != 1:
        raise InputError(
            f"{folder}: pictures are of one receiver, {record.name} has {len(record.receivers)}; give .npz"
        )
    files = [file for file in folder.glob("*.png") if file.stem.isascii() and file.stem.isdecimal()]
    if not files:
        raise InputError(f"{folder}: no pictures 0.png, 1.png, ...; give pred_spectrum, or of WRF-GS+ a folder in it")
    # The scripts count test rows from 0; the data set's names are its rows from 1, in five digits.
    named = any(file.stem[0] == "0" and len(file.stem) > 1 for file in files)
    candidate_rows = np.arange(len(record)) if named else test
    numbers = np.array([int(file.stem) - named for file in files])
    for wrong in np.flatnonzero((numbers < 0) | (numbers >= len(candidate_rows))):
        text = f"no row belongs to it, {record.name} has {len(candidate_rows)} {'' if named else 'test '}rows"
        raise InputError(f"{files[wrong]}: {text}; {REMEDY}")
    rows, height, width = candidate_rows[numbers], *record.observation.shape[2:]
    prediction, drawn = np.zeros((len(rows), height, width), np.float32), False
    for k, (file, row) in enumerate(zip(files, rows, strict=True)):
        plots = _plots(file, height, width)
        prediction[k] = read_grey(file, int(file.stem), (height, width)) if plots is None else plots[0]
        if plots is not None:
            drawn = True
            difference = np.abs(plots[1] - minmax_scale(record.observation[0, row])).mean()
            _refuse_other(file, record, rows[k : k + 1], np.array([difference]), SAME_SPECTRUM, "")
    if drawn:
        text = "plots show each spectrum from its minimum to its maximum: predictions are scored so scaled"
        logger.warning("%s: %s; store grey pictures to score their scale", folder, text)
    return {"prediction": prediction[None], "row": rows}


def _plots(file: Path, height: int, width: int) -> NDArray[np.float32] | None:
    """Spectra [2, height, width] in 0..1 of two polar plots, prediction and measurement; None: a picture without alpha.

    The radius is the zenith angle, rows of a spectrum from the rim to the centre; the angle is the azimuth.
    """
    try:
        with open_picture(file, MOST_PIXELS) as image:
            if image.mode != "RGBA":
                return None
            pixels = np.asarray(image)
    except PICTURE_ERRORS as error:
        raise DataFault(file, f"unreadable ({one_line(error)}); run the test script again") from None
    opaque = pixels[..., 3] > 0
    lines, columns = (np.flatnonzero(opaque.any(axis=axis)) for axis in (1, 0))
    discs = np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1)
    if len(discs) != 2 or any(abs(len(disc) - len(lines)) > 2 for disc in discs):
        raise DataFault(file, "not two polar plots on a transparent ground; give grey pictures, or the script's own")
    # Each cell is read at its middle; near the centre several azimuths share a pixel, and differ little.
    radius = (np.arange(height)[::-1, None] + 0.5) / height * len(lines) / 2
    azimuth = (np.arange(width) + 0.5) * 2 * np.pi / width
    across, up = radius * np.cos(azimuth), radius * np.sin(azimuth)
    line = np.floor(lines.mean() + 0.5 - up).astype(int)
    colours = np.stack([pixels[line, np.floor(disc.mean() + 0.5 + across).astype(int), :3] for disc in discs])
    return _levels(file, colours)


def _levels(file: Path, colours: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Values in 0..1 of colours [..., 3] of the maps that the scripts use."""
    from scipy.spatial import cKDTree

    distinct, place = np.unique(colours.reshape(-1, 3), axis=0, return_inverse=True)
    for name in COLOUR_MAPS:
        table = np.floor(255 * colormaps[name](np.arange(256))[:, :3] + 0.5)  # as Matplotlib's renderer rounds
        difference, level = cKDTree(table).query(distinct, p=np.inf)
        if difference.max() <= SAME_COLOUR:
            values: NDArray[np.float32] = (level[place].reshape(colours.shape[:-1]) / 255).astype(np.float32)
            return values
    raise DataFault(
        file, f"colours of neither {' nor '.join(COLOUR_MAPS)}; draw with one of them, or give grey pictures"
    )
