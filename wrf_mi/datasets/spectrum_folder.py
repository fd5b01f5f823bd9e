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

from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..core.files import atomic_folder, one_line, text_lines
from ..core.types import IntArray
from .folder_files import (
    POSITIONS,
    TX_ANTENNA_WORDS,
    antenna_entry,
    data_folder,
    finite_numbers,
    read_antenna,
    read_official,
    read_positions,
    read_yaml,
    refuse_unstated,
    shown,
    unit_quaternion,
    whole_number,
    write_lines,
    write_official,
    write_positions,
)

CARRIER_KEYS = ("frequency_hz", "frequencies_hz", "carrier_hz")
"""Keys under which a file may state carriers."""
GATEWAYS, FOLDS, TX_ANTENNA = "gateway_info.yml", "blocked_folds.txt", "tx_antenna"
RESERVED = ("array", TX_ANTENNA)
"""Mappings of the file that are no receivers; receivers cannot have these names."""
GREY_LEVELS = {"L": 255, "I;16": 65535, "I;16B": 65535, "I": 65535}
"""Largest grey value of each Pillow image mode that a grey PNG opens in (older Pillow reads 16 bits as ``I``)."""


def read_spectrum_folder(path: str | Path, name: str | None = None) -> Record:
    """Read and check a folder in the NeRF2 spectrum layout (see ``docs/data.md``).

    Args:
        path: path of the folder.
        name: name of the record; by default that of the folder.

    Returns:
        A record with ``task="spectrum"``, positions [n, 3] in metres and ``observation`` [n_rx, n, height, width]
        in 0..1.

    Raises:
        InputError: anything missing, unreadable or inconsistent; one line with the file and the row.
    """
    folder = data_folder(path, f"{GATEWAYS}, tx_pos.csv and spectrum/")
    gateways = folder / GATEWAYS
    info = read_yaml(gateways)
    receivers = _receivers(gateways, info, _array(gateways, info, "array"))
    positions, carriers = read_positions(folder / POSITIONS)
    stated = _frequency(gateways, info)
    if stated is not None and carriers is not None:
        text = f"line 1: column frequency_hz, but {GATEWAYS} states a carrier too"
        raise InputError(f"{folder / POSITIONS}: {text}; remove one of them")
    images, folds = folder / "spectrum", folder / FOLDS
    image_folders = [images] if len(receivers) == 1 else [images / receiver.name for receiver in receivers]
    record = Record(
        name=name or folder.resolve().name,
        task="spectrum",
        tx_pos_m=positions,
        receivers=receivers,
        observation=_read_images(image_folders, len(positions)),
        official=read_official(folder, len(positions), first=1),
        folds=parse_folds(folds, len(positions)) if folds.exists() else None,
        frequencies_hz=stated,
        tx_antenna=read_antenna(gateways, TX_ANTENNA, info.get(TX_ANTENNA), TX_ANTENNA_WORDS),
        source=str(folder),
    )
    return record if carriers is None else record.at_carriers(carriers)


def write_spectrum_folder(
    path: str | Path,
    record: Record,
    bits: int = 8,
    replace: bool = False,
    extra: Mapping[str, str | bytes] | None = None,
) -> Path:
    """Write a record atomically in the NeRF2 spectrum layout.

    Args:
        path: path of the folder.
        record: record with ``observation`` [n_rx, n, height, width] in 0..1, which is rounded to grey levels.
        bits: bits per pixel, 8 or 16.
        replace: replace an existing folder.
        extra: content of further files by their paths in the folder.

    Raises:
        InputError: the folder exists or cannot be written, or the record holds no spectra in 0..1 or values that the
            layout does not state: truth, headings, or frequencies of subcarriers.
    """
    if bits not in (8, 16):
        raise InputError(f"{path}: {bits} bits per pixel; choose 8 or 16")
    if (
        record.observation.ndim != 4
        or np.iscomplexobj(record.observation)
        or not (record.observation.min() >= 0 and record.observation.max() <= 1)
    ):
        raise InputError(f"{path}: {record.name} holds no spectra within 0..1; scale them first")
    for name in (receiver.name for receiver in record.receivers if receiver.name in RESERVED):
        raise InputError(f"{path}: a receiver is named {name!r}, which means something else in {GATEWAYS}; rename it")
    if record.frequencies_hz is not None and len(record.frequencies_hz) != 1:
        text = f"{record.name} has {len(record.frequencies_hz)} carriers for all rows, and {GATEWAYS} states one"
        raise InputError(f"{path}: {text}; give that of each row in Record.carriers_hz")
    refuse_unstated(path, record, "truth", "tx_heading_rad", "uplink", "n_readings", "std")
    grey = np.rint(record.observation * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    with atomic_folder(Path(path), replace) as part:
        several = len(record.receivers) > 1
        for receiver, spectra in zip(record.receivers, grey, strict=True):
            images = part / "spectrum" / receiver.name if several else part / "spectrum"
            images.mkdir(parents=True)
            for row, image in enumerate(spectra, start=1):
                Image.fromarray(image).save(images / f"{row:05d}.png")
        content: dict[str, Any] = {"dataset_name": record.name}
        for rx in record.receivers:
            entry = {"position": rx.position_m.tolist(), "orientation": rx.orientation_xyzw.tolist()}
            if antenna := antenna_entry(rx.antenna):
                entry["antenna"] = antenna
            if rx.array_m is not None:
                entry["array"] = {"elements_m": rx.array_m.tolist()}
            content[rx.name] = entry
        if antenna := antenna_entry(record.tx_antenna):
            content[TX_ANTENNA] = antenna
        if record.frequencies_hz is not None:
            content["frequency_hz"] = float(record.frequencies_hz[0])
        info = yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
        (part / GATEWAYS).write_text(info, encoding="utf-8")
        write_positions(part / POSITIONS, record.tx_pos_m, record.carriers_hz)
        write_official(part, record, first=1, digits=5)
        if record.folds is not None:
            write_lines(part / FOLDS, [str(fold) for fold in record.folds])
        for name, data in (extra or {}).items():
            (part / name).parent.mkdir(exist_ok=True)
            (part / name).write_bytes(data.encode() if isinstance(data, str) else data)
    return Path(path)


def parse_folds(path: Path, rows: int) -> IntArray:
    """Spatial fold of each row, shape [rows], from a text file with one number per line.

    Raises:
        InputError: a line that is no number, a wrong number of lines, or folds that are not 0, 1, ... without gaps.
    """
    folds = np.array([whole_number(path, line, text) for line, text in enumerate(text_lines(path), start=1)], np.int64)
    if len(folds) != rows:
        raise InputError(f"{path}: {len(folds)} folds for {rows} rows; give one line per row of tx_pos.csv")
    present = np.unique(folds)
    missing = np.flatnonzero(present != np.arange(len(present)))
    if len(missing) or len(present) < 2:
        what = f"fold {missing[0]} has no row" if len(missing) else "there is one fold only"
        raise InputError(f"{path}: {what}; number the folds 0, 1, ... without gaps, two at least")
    return folds


def _frequency(path: Path, info: dict[Any, Any]) -> FloatArray | None:
    """The carrier [1] of all rows, stated for all receivers or in their entries; None if it is not stated."""
    stated = {key: info[key] for key in CARRIER_KEYS if key in info}
    for name, entry in info.items():
        if isinstance(entry, dict):
            stated |= {f"{name}: {key}": entry[key] for key in CARRIER_KEYS if key in entry}
    carriers: dict[float, str] = {}
    for where, value in stated.items():
        for number in value if isinstance(value, list) else [value]:
            try:
                frequency_hz = float(number)  # YAML reads 920e6 as text
            except (TypeError, ValueError):
                frequency_hz = np.nan
            if not 0 < frequency_hz < np.inf:
                text = f"{one_line(where)} is {shown(value)}"
                raise InputError(f"{path}: {text}; give the carrier in Hz, such as 920e6")
            carriers[frequency_hz] = where
    if len(carriers) > 1:
        (a, first), (b, second) = list(carriers.items())[:2]
        text = f"{one_line(first)} of {a:g} and {one_line(second)} of {b:g}: several carriers, but this file states one"
        remedy = f"give those of rows in {POSITIONS}, column frequency_hz, or make a folder for each"
        raise InputError(f"{path}: {text}; {remedy}")
    return np.array(list(carriers)) if carriers else None


def _array(path: Path, entry: dict[Any, Any], name: str) -> FloatArray | None:
    """Elements [m, 3] of an entry's ``array``, which messages call ``name``; None if it has none."""
    if "array" not in entry:
        return None
    array = entry["array"]
    try:
        if "elements_m" in array:
            elements = np.array(array["elements_m"], float)
        else:
            rows, columns = (operator.index(array[key]) for key in ("rows", "columns"))
            elements = planar_array(rows, columns, float(array["spacing_m"]))
    except (TypeError, ValueError, KeyError):
        elements = np.empty(0)
    if elements.ndim != 2 or elements.shape[1] != 3 or not np.isfinite(elements).all():
        remedy = "give rows, columns and spacing_m, or elements_m as a list of x, y, z in metres"
        raise InputError(f"{path}: {one_line(name)} is {str(array)[:60]!r}; {remedy}")
    return elements


def _receivers(path: Path, info: dict[Any, Any], array_m: FloatArray | None) -> tuple[Receiver, ...]:
    """Receivers of the file; ``array_m`` is the array of those that state none."""
    poses = {key: value for key, value in info.items() if isinstance(value, dict) and key not in RESERVED}
    if not poses:
        raise InputError(f"{path}: no receiver in it; give gateway1 with position and orientation")
    receivers = []
    for name, pose in poses.items():
        if not isinstance(name, str) or Path(name).name != name:
            raise InputError(f"{path}: {name!r} cannot name a folder; call receivers gateway1, gateway2, ...")
        position = finite_numbers(path, f"{name}: position", pose.get("position"), 3)
        orientation = unit_quaternion(path, name, pose.get("orientation"))
        antenna = read_antenna(path, f"{name}: antenna", pose.get("antenna"))
        elements_m = _array(path, pose, f"{name}: array") if "array" in pose else array_m
        receivers.append(Receiver(name, position, orientation, antenna, elements_m))
    return tuple(receivers)


def _read_images(folders: list[Path], rows: int) -> NDArray[np.float32]:
    names = [f"{row:05d}.png" for row in range(1, rows + 1)]
    for folder in folders:
        if not folder.is_dir():
            text = "images lie in spectrum/, or in spectrum/NAME/ for several receivers"
            raise InputError(f"{folder}: missing folder; {text}")
        present = {entry.name for entry in folder.iterdir() if entry.suffix.lower() == ".png"}
        text = f"{len(present)} images for {rows} rows of tx_pos.csv"
        if lacking := sorted(set(names) - present):
            text += f", row {names.index(lacking[0]) + 1} has none"
            raise InputError(f"{folder / lacking[0]}: missing ({text}); add the image or remove the row")
        if extra := sorted(present - set(names)):
            raise InputError(
                f"{folder / extra[0]}: no row belongs to it ({text}); add its position or remove the image"
            )
    height, width = _read_grey(folders[0] / names[0], 1).shape
    observation = np.empty((len(folders), rows, height, width), np.float32)
    for receiver, folder in enumerate(folders):
        for row, name in enumerate(names):
            grey = _read_grey(folder / name, row + 1)
            if grey.shape != (height, width):
                text = f"{grey.shape[1]} x {grey.shape[0]} pixels, but the first image has {width} x {height}"
                raise InputError(f"{folder / name}: row {row + 1}: {text}; give all images one size")
            observation[receiver, row] = grey
    return observation


def _read_grey(path: Path, row: int) -> NDArray[np.float32]:
    try:
        with Image.open(path) as image:
            mode = image.mode
            values = np.asarray(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: row {row}: unreadable ({one_line(error)}); replace the image") from None
    if mode not in GREY_LEVELS:
        raise InputError(f"{path}: row {row}: image mode {mode}; give a grey PNG of 8 or 16 bits")
    return values.astype(np.float32) / np.float32(GREY_LEVELS[mode])
