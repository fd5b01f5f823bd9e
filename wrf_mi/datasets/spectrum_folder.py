"""The NeRF2 spectrum layout: one folder of grey images, positions and receiver poses (``docs/data.md`` has the files).

Source: NeRF2, Zhao et al., MobiCom 2023, https://github.com/XPengZhao/NeRF2. Carrier, arrays, antennas and folds are
ours and optional. ``dataset_name`` and other plain values beside the receivers are not used.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from ..core import DataFault, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..core.carriers import FREQUENCY
from ..core.files import atomic_folder, one_line, text_lines
from ..core.memory import require_memory
from ..core.pictures import PICTURE_ERRORS, open_picture
from ..core.types import IntArray
from ..core.yaml_files import read_yaml
from ..tasks import SPECTRUM
from . import folder_files as files
from .faults import attempt, recoverable, refuse, stop_at_faults

GATEWAYS, FOLDS, IMAGES = "gateway_info.yml", "blocked_folds.txt", "spectrum"
RESERVED = ("array", files.TX_ANTENNA)  # mappings of the file that are no receivers; receivers cannot have these names
MOST_PIXELS = 1 << 22  # most pixels of a spectrum: 2,048 elevations and as many azimuths
MOST_ELEMENTS = 1 << 14  # most elements of an array: 128 x 128
GREY_LEVELS = {"L": 255, "I;16": 65535, "I;16B": 65535, "I": 65535}
"""Largest grey value of each Pillow image mode that a grey PNG opens in (older Pillow reads 16 bits as ``I``)."""


def read_spectrum_folder(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the NeRF2 spectrum layout (see ``docs/data.md``).

    Returns:
        A record, by default named after the folder, with ``task="spectrum"``, positions [n, 3] in metres and
        ``observation`` [n_rx, n, height, width] in 0..1.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the row.
    """
    folder = files.data_folder(path, f"{GATEWAYS}, tx_pos.csv and spectrum/")
    gateways = folder / GATEWAYS
    info = attempt(read_yaml, gateways)
    poses = attempt(_poses, gateways, info, complete=True)
    array = attempt(_array, gateways, info, "array")
    receivers = attempt(_receivers, gateways, poses, array)
    table = attempt(files.read_positions, folder / files.POSITIONS)
    carrier = attempt(_frequency, gateways, info)
    with recoverable():
        if carrier.value is not None and table.value.carriers_hz is not None:
            text = f"column frequency_hz, but {GATEWAYS} states a carrier too; remove one of them"
            raise DataFault(folder / files.POSITIONS, text, line=1)
    rows = attempt(lambda read: len(read.positions_m), table)
    observation = attempt(_read_images, folder / IMAGES, poses, rows)
    official = attempt(files.read_official, folder, rows, 1)
    folds = attempt(parse_folds, folder / FOLDS, rows) if (folder / FOLDS).exists() else None
    tx_antenna = attempt(files.read_tx_antenna, gateways, info)
    stop_at_faults()
    return files.folder_record(
        folder,
        name,
        SPECTRUM,
        tx_pos_m=table.value.positions_m,
        receivers=receivers,
        observation=observation,
        official=official,
        folds=folds,
        frequencies_hz=carrier,
        tx_antenna=tx_antenna,
        runs=table.value.runs,
    ).at_carriers(table.value.carriers_hz)


def write_spectrum_folder(
    path: str | Path,
    record: Record,
    bits: int = 8,
    replace: bool = False,
    extra: Mapping[str, str | bytes] | None = None,
) -> Path:
    """Write a record atomically in the NeRF2 spectrum layout.

    ``observation`` [n_rx, n, height, width] in 0..1 is rounded to grey levels of 8 or 16 ``bits``. ``extra`` is the
    content of further files by their paths in the folder.

    Raises:
        InputError: the folder exists or cannot be written, or the record holds no spectra in 0..1 or values that the
            layout does not state: truth, headings, or frequencies of subcarriers.
    """
    if bits not in (8, 16):
        raise InputError(f"{path}: {bits} bits per pixel; choose 8 or 16")
    _check_writable(path, record)
    grey = np.rint(record.observation * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    several = len(record.receivers) > 1
    with atomic_folder(Path(path), replace) as part:
        for receiver, spectra in zip(record.receivers, grey, strict=True):
            images = part / IMAGES / receiver.name if several else part / IMAGES
            images.mkdir(parents=True)
            for row, image in enumerate(spectra, start=1):
                Image.fromarray(image).save(images / f"{row:05d}.png")
        info = yaml.safe_dump(_gateway_info(record), sort_keys=False, default_flow_style=None)
        (part / GATEWAYS).write_text(info, encoding="utf-8")
        table = files.PositionTable(record.tx_pos_m, record.carriers_hz, record.runs)
        files.write_positions(part / files.POSITIONS, table)
        files.write_official(part, record.official, first=1, digits=5)
        if record.folds is not None:
            files.write_lines(part / FOLDS, [str(fold) for fold in record.folds])
        files.write_patterns(part, record)
        files.write_extra(part, extra)
    return Path(path)


def _check_writable(path: str | Path, record: Record) -> None:
    spectra = record.observation
    if spectra.ndim != 4 or np.iscomplexobj(spectra) or not 0 <= spectra.min() <= spectra.max() <= 1:
        raise InputError(f"{path}: {record.name} holds no spectra within 0..1; scale them first")
    for name in (receiver.name for receiver in record.receivers if receiver.name in RESERVED):
        raise InputError(f"{path}: a receiver is named {name!r}, which means something else in {GATEWAYS}; rename it")
    if record.frequencies_hz is not None and len(record.frequencies_hz) != 1:
        text = f"{record.name} has {len(record.frequencies_hz)} carriers for all rows, and {GATEWAYS} states one"
        raise InputError(f"{path}: {text}; give that of each row in Record.carriers_hz")
    files.refuse_runs(path, record)
    files.refuse_unstated(path, record, "truth", "tx_heading_rad", "uplink", "n_readings", "std")


def _gateway_info(record: Record) -> dict[str, Any]:
    content: dict[str, Any] = {"dataset_name": record.name}
    for rx in record.receivers:
        content[rx.name] = {"position": rx.position_m.tolist(), "orientation": rx.orientation_xyzw.tolist()}
        if antenna := files.antenna_entry(rx.antenna):
            content[rx.name]["antenna"] = antenna
        if rx.array_m is not None:
            content[rx.name]["array"] = {"elements_m": rx.array_m.tolist()}
    if antenna := files.antenna_entry(record.tx_antenna):
        content[files.TX_ANTENNA] = antenna
    if record.frequencies_hz is not None:
        content["frequency_hz"] = float(record.frequencies_hz[0])
    return content


def parse_folds(path: Path, rows: int) -> IntArray:
    """Spatial fold of each row, shape [rows], from a text file with one number per line.

    Raises:
        InputError: a line that is no number, a wrong number of lines, or folds that are not 0, 1, ... without gaps.
    """
    lines = text_lines(path)
    folds = np.full(len(lines), -1)
    for line, text in enumerate(lines, start=1):
        with recoverable():
            folds[line - 1] = files.whole_number(path, line, text)
    if len(folds) != rows:
        refuse(DataFault(path, f"{len(folds)} folds for {rows} rows; give one line per row of tx_pos.csv"))
    present = np.unique(folds[folds >= 0])
    missing = np.flatnonzero(present != np.arange(len(present)))
    if len(missing) or len(present) < 2:
        what = f"fold {missing[0]} has no row" if len(missing) else "there is one fold only"
        raise DataFault(path, f"{what}; number the folds 0, 1, ... without gaps, two at least")
    return folds


def _frequency(path: Path, info: dict[Any, Any]) -> FloatArray | None:
    """The carrier [1] of all rows; None if it is not stated."""
    if (entry := info.get(FREQUENCY)) is None:
        return None
    carrier_hz = files.numbers_of(entry)  # YAML reads 920e6 as text
    if carrier_hz.ndim or not 0 < carrier_hz < np.inf:
        remedy = f"give the carrier in Hz, such as 920e6, or those of rows in {files.POSITIONS}, column {FREQUENCY}"
        raise DataFault(path, f"{FREQUENCY} is {files.shown(entry)}; {remedy}")
    return carrier_hz.reshape(1)


def _array(path: Path, entry: dict[Any, Any], name: str) -> FloatArray | None:
    """Elements [m, 3] of an entry's ``array``, which messages call ``name``; None if it has none."""
    if "array" not in entry:
        return None
    array = entry["array"]
    try:
        elements = np.array(array["elements_m"], float) if "elements_m" in array else _planar(path, array, name)
    except InputError:
        raise
    except (TypeError, ValueError, KeyError, OverflowError):
        elements = np.empty(0)
    if elements.shape[1:] != (3,) or not np.isfinite(elements).all():
        remedy = "give rows, columns and spacing_m, or elements_m as a list of x, y, z in metres"
        text = f"{one_line(name)} is {files.shown(array if isinstance(array, dict) else str(array))}"
        raise DataFault(path, f"{text}; {remedy}")
    return elements


def _planar(path: Path, array: dict[Any, Any], name: str) -> FloatArray:
    rows, columns = operator.index(array["rows"]), operator.index(array["columns"])
    if rows * columns > MOST_ELEMENTS:
        raise DataFault(path, f"{one_line(name)} has {rows} x {columns} elements; give {MOST_ELEMENTS} at most")
    return planar_array(rows, columns, float(array["spacing_m"]))


def _poses(path: Path, info: dict[Any, Any]) -> dict[str, dict[Any, Any]]:
    poses = {key: value for key, value in info.items() if isinstance(value, dict) and key not in RESERVED}
    if not poses:
        raise DataFault(path, "no receiver in it; give gateway1 with position and orientation")
    for name in poses:
        if Path(str(name)).name != name or name == ".." or not name.isprintable():
            refuse(DataFault(path, f"{name!r} cannot name a folder; call receivers gateway1, gateway2, ..."))
    return poses


def _receivers(path: Path, poses: dict[str, dict[Any, Any]], array_m: FloatArray | None) -> tuple[Receiver, ...]:
    """Receivers of the entries; ``array_m`` is the array of those that state none."""
    receivers = []
    for name, pose in poses.items():
        position = attempt(files.finite_numbers, path, f"{name}: position", pose.get("position"), 3)
        orientation = attempt(files.unit_quaternion, path, name, pose.get("orientation"))
        antenna = attempt(files.read_antenna, path, f"{name}: antenna", pose.get("antenna"))
        array = attempt(_array, path, pose, f"{name}: array")
        with recoverable():
            elements_m = array.value if "array" in pose else array_m
            receivers.append(Receiver(name, position.value, orientation.value, antenna.value, elements_m))
    return tuple(receivers)


def _read_images(folder: Path, poses: dict[str, dict[Any, Any]], rows: int) -> NDArray[np.float32]:
    """Spectra [receivers, rows, height, width]."""
    observation: NDArray[np.float32] | None = None
    for receiver, place in enumerate([folder] if len(poses) == 1 else [folder / name for name in poses]):
        for row, image in _images(place, rows).items():
            with recoverable():
                grey = read_grey(image, row, None if observation is None else observation.shape[2:])
                if observation is None:
                    what = f"{folder}: {len(poses) * rows} spectra of {grey.shape[1]} x {grey.shape[0]} pixels"
                    needed = 4 * len(poses) * rows * grey.size
                    require_memory(needed, what, "give images of fewer pixels, or fewer rows")
                    observation = np.zeros((len(poses), rows, *grey.shape), np.float32)
                observation[receiver, row - 1] = grey
    stop_at_faults()
    assert observation is not None
    return observation


def _images(place: Path, rows: int) -> dict[int, Path]:
    """The image of each row, from 1, that a receiver's folder has."""
    if not place.is_dir():
        refuse(DataFault(place, "missing folder; images lie in spectrum/, or in spectrum/NAME/ for several receivers"))
        return {}
    row_of = {f"{row:05d}.png": row for row in range(1, rows + 1)}
    present = {entry.name for entry in place.iterdir() if entry.suffix.lower() == ".png"}
    count = f"{len(present)} images for {rows} rows of {files.POSITIONS}"
    for image in sorted(row_of.keys() - present, key=row_of.__getitem__):
        text = f"missing ({count}); add the image or remove the row"
        refuse(DataFault(place / image, text, row=row_of[image], file_per_row=True))
    for image in sorted(present - row_of.keys()):
        text = f"no row belongs to it ({count}); add its position or remove the image"
        refuse(DataFault(place / image, text, file_per_row=True))
    return {row: place / image for image, row in row_of.items() if image in present}


def read_grey(path: Path, row: int, size: tuple[int, ...] | None) -> NDArray[np.float32]:
    """Grey values [height, width] in 0..1 of a row's picture (InputError: unreadable, or another ``size`` or mode)."""
    try:
        with open_picture(path, MOST_PIXELS) as image:
            if size is not None and image.size != size[::-1]:
                (width, height), (first_height, first_width) = image.size, size
                text = f"{width} x {height} pixels, but the first image has {first_width} x {first_height}"
                raise DataFault(path, f"{text}; give all images one size", row=row, file_per_row=True)
            if image.mode not in GREY_LEVELS:
                text = f"image mode {image.mode}; give a grey PNG of 8 or 16 bits"
                raise DataFault(path, text, row=row, file_per_row=True)
            return np.asarray(image).astype(np.float32) / np.float32(GREY_LEVELS[image.mode])
    except InputError:
        raise
    except PICTURE_ERRORS as error:
        text = f"unreadable ({one_line(error)}); replace the image"
        raise DataFault(path, text, row=row, file_per_row=True) from None
