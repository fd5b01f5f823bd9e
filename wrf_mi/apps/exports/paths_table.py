"""Propagation paths as a table, CSV with one row for each path, and as a scenario of DeepMIMO."""

from __future__ import annotations

import logging
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from ...core import InputError, Paths, Receiver
from ...core.angles import FloatArray, azimuth_elevation, unit_vectors
from ...core.antenna import UPRIGHT
from ...core.files import write_csv
from ...datasets.folder_files import CsvTable, read_csv
from ...tracing import TraceOptions, TraceResult, open_scene, trace_paths, write_deepmimo
from ...tracing.options import stated_kinds, without_effect
from .format import RUN, ExportOptions
from .source import Source

logger = logging.getLogger(__name__)

LETTERS = {1: "R", 2: "S", 4: "T", 8: "D"}
"""Letters of the kinds of interaction: reflection, scattering, transmission, diffraction."""
CODES = {letter: code for code, letter in LETTERS.items()}
ANGLES = ("azimuth", "elevation")
SEPARATOR = ";"  # between the interactions, vertices and objects of a path


def path_columns(traced: TraceResult) -> dict[str, Any]:
    """Columns of the table of a trace, [p] each, see ``docs/export.md``."""
    paths = traced.paths
    rx_pos_m = np.stack([receiver.position_m for receiver in traced.receivers])
    columns: dict[str, Any] = {"tx": paths.tx.tolist(), "rx": paths.rx.tolist()}
    columns["receiver"] = [traced.receivers[index].name for index in paths.rx]
    columns["frequency_hz"] = traced.path_carriers_hz.tolist()
    for name, values in (("tx", traced.tx_pos_m[paths.tx]), ("rx", rx_pos_m[paths.rx])):
        columns |= {f"{name}_{axis}": column.tolist() for axis, column in zip("xyz", values.T, strict=True)}
    columns |= {"gain_re": paths.gain.real.tolist(), "gain_im": paths.gain.imag.tolist()}
    columns |= {"length_m": paths.length_m.tolist(), "delay_s": (paths.length_m / speed_of_light).tolist()}
    for end in ("departure", "arrival"):
        for name, radians in zip(ANGLES, azimuth_elevation(getattr(paths, end)), strict=True):
            columns[f"{end}_{name}_deg"] = np.degrees(radians).tolist()
    counts = paths.bounces

    def joined(of: Callable[[int, int], str]) -> list[str]:
        return [SEPARATOR.join(of(path, k) for k in range(count)) for path, count in enumerate(counts)]

    columns["interactions"] = joined(lambda path, k: LETTERS[int(paths.interactions[path, k])])
    # tolist gives Python's numbers, whose text reads back as the same number.
    vertices = paths.vertices_m.astype(float).tolist()
    columns["vertices_m"] = joined(lambda path, k: " ".join(map(repr, vertices[path][k])))
    columns["objects"] = joined(lambda path, k: paths.object_names[paths.objects[path, k]])
    return columns


def traced_paths(source: Source, options: ExportOptions) -> TraceResult:
    """Stored paths of a run, or paths of a scene that are traced now."""
    ends = {"--tx": options.tx_pos_m, "--rx": options.rx_pos_m, "--frequency": options.frequency_hz}
    if source.kind == RUN:
        more = {"--material": options.material, "--paths": options.kinds, "--depth": options.depth}
        if unused := [name for name, value in (ends | more).items() if value is not None]:
            raise InputError(f"{source.name}: a run, whose paths are traced; omit {unused[0]}, or give its scene")
        return source.trace()
    return _traced_now(source, ends, options)


def _traced_now(source: Source, ends: dict[str, Any], options: ExportOptions) -> TraceResult:
    if options.tx_pos_m is None or options.rx_pos_m is None or options.frequency_hz is None:
        lacking = ", ".join(name for name, value in ends.items() if value is None)
        raise InputError(f"{source.name}: a scene; state where its paths begin and end: give {lacking}")
    scene = open_scene(source.name, options.frequency_hz, material=options.material)
    receivers = [Receiver(f"rx{k}", position, np.array(UPRIGHT)) for k, position in enumerate(options.rx_pos_m)]
    return trace_paths(scene, options.tx_pos_m, receivers, _trace_options(options), options.progress)


def _trace_options(options: ExportOptions) -> TraceOptions:
    """Stated kinds of paths and depth; those without effect are logged."""
    chosen: dict[str, Any] = {} if options.kinds is None else stated_kinds(options.kinds)
    chosen |= {} if options.depth is None else {"depth": options.depth}
    trace_options = TraceOptions(**chosen)
    for name, reason in without_effect(trace_options).items():
        if name not in chosen:
            continue
        option = "--depth" if name == "depth" else f"--paths {name}"
        logger.warning("%s has no effect: %s", option, reason)
    return trace_options


def write_paths(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write paths of a run or a scene as CSV (`wrf_mi.apps.exports.source.Write`).

    `InputError`: a run without stored paths, a scene without transmitters, receivers or frequency.
    """
    traced = traced_paths(source, options)
    if not len(traced.paths):
        raise InputError(f"{source.name}: no path from {traced.paths.n_tx} transmitters; nothing to write")
    columns = path_columns(traced)
    write_csv(out, columns, zip(*columns.values(), strict=True))
    return {"paths": len(traced.paths), "transmitters": traced.paths.n_tx, "receivers": traced.paths.n_rx}


def write_scenario(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write paths of a run or a scene as a scenario of DeepMIMO (`wrf_mi.apps.exports.source.Write`)."""
    traced = traced_paths(source, options)
    write_deepmimo(out, traced, options.replace)
    return {"paths": len(traced.paths), "users": traced.paths.n_tx, "base stations": traced.paths.n_rx}


def read_paths(file: str | Path) -> Paths:
    """Paths of a table of `write_paths`.

    Gains, lengths and vertices are those that were written; directions, which are stored as angles, to 1e-15. Numbers
    of transmitters and receivers are those up to the last one with a path. `InputError`: a file that is missing, or has
    a column or a field less or another kind of value.
    """
    table = read_csv(Path(file))
    tx, rx = (table.numbers(name).astype(np.int64) for name in ("tx", "rx"))
    gain = table.numbers("gain_re") + 1j * table.numbers("gain_im")
    directions = _directions(table, "departure"), _directions(table, "arrival")
    counts = (int(numbers.max(initial=-1)) + 1 for numbers in (tx, rx))
    return Paths(tx, rx, gain, table.numbers("length_m"), *directions, *_bounces(file, table), *counts)


def _bounces(file: str | Path, table: CsvTable) -> Any:
    """Interactions [p, k], vertices [p, k, 3], objects [p, k] and their names, as `Paths` has them."""
    kinds, points, met = (list(map(_items, table.texts(name))) for name in ("interactions", "vertices_m", "objects"))
    shape = len(kinds), max(map(len, kinds), default=0)
    interactions, objects = np.zeros(shape, np.uint8), np.full(shape, -1, np.int32)
    vertices = np.full((*shape, 3), np.nan)
    names = list(dict.fromkeys(chain(*met)))
    for path, items in enumerate(zip(kinds, points, met, strict=True)):
        try:
            for k, (kind, point, name) in enumerate(zip(*items, strict=True)):
                interactions[path, k], objects[path, k] = CODES[kind], names.index(name)
                vertices[path, k] = [float(number) for number in point.split()]
        except (ValueError, KeyError):
            text = "interactions, vertices and objects do not fit"
            raise InputError(f"{file}, row {path + 1}: {text}; restore it") from None
    return interactions, vertices, objects, tuple(names)


def _items(text: str) -> list[str]:
    return text.split(SEPARATOR) if text else []


def _directions(table: CsvTable, end: str) -> FloatArray:
    return unit_vectors(*(np.radians(table.numbers(f"{end}_{name}_deg")) for name in ANGLES))
