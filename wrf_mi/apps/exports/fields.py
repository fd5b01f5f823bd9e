"""Fields of Gaussians: as PLY of 3D Gaussian splatting, and as one file with all parameters, which makes a run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from matplotlib import colormaps

from ...core import InputError
from ...core.angles import FloatArray
from ...core.array_files import keyed, stored_arrays, under, write_arrays
from ...core.carriers import carriers_text
from ...core.files import atomic_folder, one_line, readable, write_atomically
from ...estimators.gaussian.model import PARAM, FittedField
from ...gaussians.attributes import attributes_of
from ...gaussians.parameters import Gaussians
from ...runs.folder import CONFIG, FITTED, METRICS, SPLIT, check_format, check_new
from ...runs.run import Run, open_run
from .format import ExportOptions
from .source import Source

DEGREE_0 = 0.28209479177387814
"""Spherical harmonic of degree 0, 1 / (2 sqrt(pi)): a viewer's colour is 0.5 + `DEGREE_0` f_dc."""
RANGE_DB = 40.0  # range of magnitudes of the signal, below the strongest, over which colours differ
PACKED, CHUNK = ".compressed.ply", 256  # name of compressed files, and Gaussians of a chunk
PARTS = tuple(f"{name}_{k}" for name in ("scale", "f_dc") for k in range(3))
BOUNDED = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")  # names of the bounds of a chunk
OPAQUE = 1e-6  # least distance of an opacity from 0 and 1, whose logits are infinite
FORMAT = 2  # version of the file with all parameters
VERSION, SPLIT_ARRAYS, FITTED_ARRAYS = "export/format", "split/", "run/"
TEXTS = {CONFIG: "export/config", METRICS: "export/metrics"}  # keys of the texts of a run folder's files


def field_of(run: Run) -> FittedField:
    """The trained field of Gaussians of a run; `InputError`: a run of another model, or an unfinished one."""
    fitted = run.fitted
    if not isinstance(fitted, FittedField) or fitted.field is None:
        raise InputError(f"{run.folder}: a run of {run.config.model}, which has no Gaussians; give one of wrf-gs+")
    return fitted


def _log_carrier(run: Run, field: FittedField, frequency_hz: float | None) -> float:
    carriers_hz = field.form.carriers_hz
    if carriers_hz is None:
        if frequency_hz is not None:
            raise InputError(f"{run.folder}: its data have one carrier; omit --frequency")
        return 0.0
    if frequency_hz is None or frequency_hz not in carriers_hz:
        raise InputError(f"{run.folder}: trained with {carriers_text(carriers_hz)}; give one of them as --frequency HZ")
    return field.predictor.graph.log_carrier(int(np.searchsorted(carriers_hz, frequency_hz))) or 0.0


def splat_columns(gaussians: Gaussians) -> dict[str, FloatArray]:
    """Columns of a 3DGS file from n Gaussians for one transmitter, float32 [n] each.

    Beside the properties of 3DGS: ``signal_re_<k>``, ``signal_im_<k>`` of each complex signal k of a Gaussian, and
    under product blending ``attenuation_re``, ``attenuation_im``, the factor delta; the opacity is then 1 - abs(delta).
    """
    numbers = {name: np.array(getattr(gaussians, name), float) for name in ("position", "scale", "rotation", "signal")}
    half = len(numbers["signal"]) // 2
    signal = numbers["signal"][:half] + 1j * numbers["signal"][half:]
    delta = None if gaussians.attenuation is None else np.array(gaussians.attenuation, float)
    alpha = np.array(gaussians.opacity, float) if delta is None else 1 - np.hypot(*delta)
    alpha = np.clip(alpha, OPAQUE, 1 - OPAQUE)
    power = np.square(np.abs(signal)).sum(axis=0)
    level_db = 10 * np.log10(np.maximum(power, np.finfo(float).tiny) / max(power.max(), np.finfo(float).tiny))
    colour = (colormaps["viridis"](1 + level_db / RANGE_DB)[:, :3] - 0.5) / DEGREE_0
    x, y, z, w = numbers["rotation"] / np.linalg.norm(numbers["rotation"], axis=0)
    columns = dict(zip("xyz", numbers["position"], strict=True))
    columns |= {f"n{axis}": np.zeros_like(alpha) for axis in "xyz"}
    columns |= _numbered("f_dc_", colour.T)
    columns |= {"opacity": np.log(alpha) - np.log1p(-alpha)}
    columns |= _numbered("scale_", np.log(numbers["scale"])) | _numbered("rot_", np.stack([w, x, y, z]))
    for k, values in enumerate(signal):
        columns |= {f"signal_re_{k}": values.real, f"signal_im_{k}": values.imag}
    if delta is not None:
        columns |= {"attenuation_re": delta[0], "attenuation_im": delta[1]}
    return {name: values.astype(np.float32) for name, values in columns.items()}


def _numbered(prefix: str, rows: FloatArray) -> dict[str, FloatArray]:
    return {f"{prefix}{k}": values for k, values in enumerate(rows)}


def write_3dgs(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write the Gaussians of a run for one transmitter (`wrf_mi.apps.exports.source.Write`).

    `InputError`: no Gaussians, a field that is trained on the uplink, or not one transmitter.
    """
    run = source.run
    field, tx_pos_m = field_of(run), options.tx_pos_m
    if field.form.features:
        text = "its Gaussians depend on the uplink channel, not on a position"
        raise InputError(f"{run.folder}: {text}; export --format field, which holds all parameters")
    if tx_pos_m is None or len(tx_pos_m) != 1:
        raise InputError(f"{run.folder}: its Gaussians depend on the transmitter; choose one by --tx X,Y,Z in metres")
    log_carrier = _log_carrier(run, field, options.frequency_hz)
    with dr.suspend_grad():
        gaussians = field.predictor.gaussians(tx_pos_m, log_carrier)
    columns = splat_columns(gaussians)
    for attribute in attributes_of(field.field):
        of_attribute = attribute.columns(field.params[attribute.name])
        columns |= {name: values.astype(np.float32) for name, values in of_attribute.items()}
    where = " ".join(f"{x:.9g}" for x in tx_pos_m[0])
    comments = [f"Gaussians of a radio field ({run.config.model}) for the transmitter at {where} m; metres, z up"]
    comments.append(f"colour: magnitude of the signal, viridis over {RANGE_DB:g} dB below the strongest")
    comments.append("signal_re_k + j signal_im_k: complex signals; time factor exp(+j omega t)")
    elements = _packed(columns) if out.name.lower().endswith(PACKED) else {"vertex": columns}
    write_atomically(out, _ply(comments, **elements))
    return {"Gaussians": len(columns["x"]), "properties": len(elements["vertex"])}


def _ply(comments: Sequence[str], **elements: Mapping[str, FloatArray]) -> bytes:
    """File of elements with columns of equal type (G. Turk, "The PLY polygon file format", 1994)."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {one_line(text)}" for text in comments)]
    rows = {name: np.stack(list(columns.values()), axis=1) for name, columns in elements.items()}
    for name, columns in elements.items():
        kind = "uint" if rows[name].dtype == np.uint32 else "float"
        header += [f"element {name} {len(rows[name])}", *(f"property {kind} {column}" for column in columns)]
    content = b"".join(values.astype(values.dtype.newbyteorder("<")).tobytes() for values in rows.values())
    return "\n".join([*header, "end_header", ""]).encode() + content


def _packed(columns: Mapping[str, FloatArray]) -> dict[str, dict[str, Any]]:
    """Elements of PlayCanvas' compressed PLY: bounds of each 256 neighbours, and attributes as shares of them.

    https://github.com/playcanvas/splat-transform; `columns` as of `splat_columns`, whose further ones it cannot hold.
    """
    values = np.stack([columns[name] for name in (*"xyz", *PARTS)]).astype(float)
    values[6:] = 0.5 + DEGREE_0 * values[6:]
    # Neighbours along a Z curve of 1024 cells a side share a chunk; the last one is filled up.
    low, extent = values[:3].min(axis=1, keepdims=True), np.ptp(values[:3], axis=1).max() or 1.0
    cells = ((values[:3] - low) / extent * 1023).astype(np.int64)
    order = np.argsort(sum((cells[axis] >> bit & 1) << 3 * bit + axis for bit in range(10) for axis in range(3)))
    count = len(order)
    filled = np.concatenate([order, np.repeat(order[-1:], -count % CHUNK)])
    chunks = values[:, filled].reshape(len(values), -1, CHUNK)
    least, most = (bounds.astype(np.float32) for bounds in (chunks.min(axis=2), chunks.max(axis=2)))
    size = np.where(most > least, most - least, 1)[..., None]
    shares = ((chunks - least[..., None]) / size).clip(0, 1).reshape(len(values), -1)[:, :count]
    bounds: dict[str, Any] = {}
    for k, (name, rows) in product((0, 3, 6), (("min", least), ("max", most))):
        bounds |= {f"{name}_{BOUNDED[row]}": rows[row] for row in range(k, k + 3)}
    # Of a quaternion of length 1 its largest component is left out, which is made positive.
    rotation = np.stack([columns[f"rot_{k}"] for k in range(4)])[:, order]
    largest = np.abs(rotation).argmax(axis=0)
    rotation = rotation * np.sign(rotation[largest, np.arange(count)])
    others = rotation.T[np.arange(4) != largest[:, None]].reshape(count, 3).T
    alpha = 1 / (1 + np.exp(-columns["opacity"][order]))
    packed = {
        "packed_position": _bits(shares[:3], 11, 10, 11),
        "packed_rotation": _bits([largest / 3, *(0.5 + others / np.sqrt(2))], 2, 10, 10, 10),
        "packed_scale": _bits(shares[3:6], 11, 10, 11),
        "packed_color": _bits([*shares[6:], alpha], 8, 8, 8, 8),
    }
    return {"chunk": bounds, "vertex": packed}


def _bits(shares: Iterable[FloatArray], *widths: int) -> Any:
    """Numbers in 0..1 side by side in 32 bits, the first one in the highest."""
    numbers = np.zeros((), np.uint32)
    for values, width in zip(shares, widths, strict=True):
        numbers = numbers << np.uint32(width) | np.rint(values * (2**width - 1)).astype(np.uint32)
    return numbers


def write_field(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write a field of Gaussians (`wrf_mi.apps.exports.source.Write`).

    Keys: ``params/<name>``, the parameters in single precision, [k, n] each; ``form/*``, the form of the observations;
    ``receivers/*`` and ``tx_antenna``; ``split/*`` and ``run/*`` of the run's ``split.npz`` and ``model.npz``; the
    texts ``export/config`` and ``export/metrics``. ``docs/export.md`` has the parameters' shapes. `InputError`: no
    Gaussians, or an unfinished run.
    """
    run = source.run
    field = field_of(run)
    form = {key: values for key, values in field.arrays().items() if not key.startswith(PARAM)}
    model = stored_arrays(run.folder / FITTED)
    arrays: dict[str, Any] = {VERSION: FORMAT, **keyed(PARAM, field.params), **form}
    arrays |= {key: values for key, values in model.items() if key.startswith(FITTED_ARRAYS)}
    arrays |= keyed(SPLIT_ARRAYS, stored_arrays(run.folder / SPLIT))
    for name, key in TEXTS.items():
        if (run.folder / name).exists():
            arrays[key] = (run.folder / name).read_text(encoding="utf-8")
    write_arrays(out, arrays, compressed=True)
    facts = {"parameters": len(field.params), "numbers": sum(values.size for values in field.params.values())}
    return facts | ({} if run.config.scene is None else {"scene (not included)": run.config.scene})


def import_field(file: str | Path, out: str | Path, overwrite: bool = False) -> Run:
    """Make a run folder of a file of `write_field`; its predictions are bit-identical to those of the exported run.

    `InputError`: a file that is missing, damaged or of another kind, or a folder that exists and is not empty, unless
    it is of a run and ``overwrite`` is true.
    """
    path, folder = Path(file), Path(out)
    check_new(folder, overwrite)
    with readable(path, f"{path}: missing; give a file of export --format field", "export it again"):
        arrays = stored_arrays(path)
        if VERSION not in arrays:
            raise InputError(f"{path}: not written by export --format field; give such a file")
        if (version := int(arrays.pop(VERSION))) != FORMAT:
            raise InputError(f"{path}: format {version}, this version reads {FORMAT}; use the version that wrote it")
        texts = {name: str(arrays.pop(key)) for name, key in TEXTS.items() if key in arrays}
        split = under(SPLIT_ARRAYS, arrays)
        model = {key: values for key, values in arrays.items() if not key.startswith(SPLIT_ARRAYS)}
        if CONFIG not in texts or not split:
            raise InputError(f"{path}: incomplete; export it again")
        for name, values in under(PARAM, model).items():
            if not np.isfinite(values).all():
                raise InputError(f"{path}: {PARAM}{name} has numbers that are not finite; export another run's field")
    with atomic_folder(folder, replace=True) as part:  # `check_new` refuses others
        write_arrays(part / SPLIT, split)
        write_arrays(part / FITTED, model, compressed=True)
        for name, text in texts.items():
            (part / name).write_text(text, encoding="utf-8")
        check_format(part)
        open_run(part)
    return open_run(folder)
