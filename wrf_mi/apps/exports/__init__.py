"""Export of runs, scenes and data sets to formats of other programs.

Other packages add a `Format` by an entry point of the group ``wrf_mi.apps.exports``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ...core import InputError
from ...core.registry import Registry, resolve
from .format import DATASET, RUN, SCENE, ExportOptions, Format

ENTRY_POINTS = "wrf_mi.exports"
SCENES = (SCENE, RUN)  # a run stands for its corrected scene, or else for the scene that it was traced in
_TRACED = ("tx_pos_m", "rx_pos_m", "frequency_hz", "material", "kinds", "depth")
_WRITERS: dict[str, tuple[tuple[str, ...], str, str, tuple[str, ...]]] = {
    "3dgs": ((RUN,), ".ply", "fields:write_3dgs", ("tx_pos_m", "frequency_hz")),
    "field": ((RUN,), ".npz", "fields:write_field", ()),
    "paths": ((RUN, SCENE), ".csv", "paths_table:write_paths", _TRACED),
    "deepmimo": ((RUN, SCENE), "", "paths_table:write_scenario", _TRACED),
    "sionna": (SCENES, "", "scenes:write_sionna", ("frequency_hz", "material")),
    "glb": (SCENES, ".glb", "scenes:write_glb", ("material",)),
    "ply": (SCENES, ".ply", "scenes:write_mesh", ("material",)),
    "spectra": ((DATASET,), "", "source:write_spectra", ()),
    "png": ((DATASET,), "", "source:write_pictures", ()),
    "ble": ((DATASET,), "", "source:write_strengths", ()),
    "nerf2-csi": ((DATASET,), "", "source:write_channels", ()),
    "npz": ((DATASET,), ".npz", "source:write_npz", ()),
}
"""Kinds of sources, suffix, writer and options of each format, as the attributes of `Format`."""
_TEXTS = {
    "3dgs": "Gaussians for the transmitter of --tx as PLY of 3D Gaussian splatting; .compressed.ply packs them",
    "field": "all parameters of a field of Gaussians in one file, without loss; `wrf-mi import` makes a run of it",
    "paths": "paths of a traced run, or of a scene from --tx to --rx at --frequency, one row each",
    "deepmimo": "paths of a traced run, or of a scene from --tx to --rx at --frequency, as a scenario of DeepMIMO",
    "sionna": "scene as a folder that sionna.rt.load_scene opens with its materials, and mi.load_file for pictures",
    "glb": "scene as one glTF file (y up) with a mesh for each surface and a coloured material for each radio material",
    "ply": "scene as one mesh (z up) with colour, material and surface of each face; `wrf-mi mesh` reads it",
    "spectra": "spectra in the layout of NeRF2, a folder of images of 16 bits (docs/data.md)",
    "png": "spectra as pictures in dB, with a file of their limits, a folder",
    "ble": "signal strengths in the layout of flat-ble, a folder of CSV files",
    "nerf2-csi": "uplink and downlink of a base station in the layout of NeRF2, a folder",
    "npz": "any data set in one file, without loss",
}
BUILT_IN = {
    name: Format(name, kinds, suffix, f"{__name__}.{writer}", options, _TEXTS[name])
    for name, (kinds, suffix, writer, options) in _WRITERS.items()
}
FORMATS = Registry[Format]("format", ENTRY_POINTS, BUILT_IN)  # all formats by name


def export(source: str | Path, format: str, out: str | Path, options: ExportOptions | None = None) -> dict[str, Any]:
    """Write a run, a scene or a data set in a format of `FORMATS`.

    Args:
        source: run folder; name of a scene, scene folder, Mitsuba XML or mesh; or name or folder of a data set. Where a
            name means several of them, the format decides.
        format: name of the format.
        out: file or folder to write.
        options: further options, of which each format takes some.

    Returns:
        Facts about what was written, by words for a reader.

    Raises:
        InputError: no such source or format, options or a name of the file that do not belong to the format, or a
            source that the format cannot hold.
    """
    if format not in FORMATS:
        raise InputError(f"format {format!r}: unknown; choose from {', '.join(FORMATS)}")
    from .source import Source, Write, kinds_of  # imports tracer and models, which the list of formats does without

    form, chosen_options = FORMATS[format], options or ExportOptions()
    form.check(Path(out), chosen_options)
    kinds = kinds_of(source)
    kind = next((kind for kind in kinds if kind in form.kinds), None)
    if kind is None:
        others = [name for name, other in FORMATS.items() if set(other.kinds) & set(kinds)]
        text = f"{source}: a {' and '.join(kinds)}; format {format} takes a {' or a '.join(form.kinds)}"
        raise InputError(f"{text}; choose from {', '.join(others)}")
    write: Write = resolve(form.writer) if isinstance(form.writer, str) else form.writer
    return write(Source(str(source), kind), Path(out), chosen_options)


def export_run(folder: str | Path, format: str, out: str | Path, **options: Any) -> dict[str, Any]:
    """`export` of a run's folder, with the fields of `ExportOptions` as arguments."""
    return dict(export(folder, format, out, ExportOptions(**options)))


__all__ = [
    "BUILT_IN",
    "DATASET",
    "ENTRY_POINTS",
    "FORMATS",
    "RUN",
    "SCENE",
    "ExportOptions",
    "Format",
    "export",
    "export_run",
]
