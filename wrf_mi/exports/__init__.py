"""Export of runs, scenes and data sets to formats of other programs.

Other packages add a `Format` by an entry point of the group ``wrf_mi.exports``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import InputError
from ..core.registry import Registry
from .format import DATASET, RUN, SCENE, ExportOptions, Format

ENTRY_POINTS = "wrf_mi.exports"
SCENES = (SCENE, RUN)
"""A run stands for its corrected scene, or else for the scene that it was traced in."""
_HERE = "wrf_mi.exports"
_TRACED = ("tx_pos_m", "rx_pos_m", "frequency_hz", "material", "kinds", "depth")

BUILT_IN = (
    Format(
        "3dgs",
        (RUN,),
        ".ply",
        f"{_HERE}.gaussians:write_3dgs",
        ("tx_pos_m", "frequency_hz"),
        "Gaussians for the transmitter of --tx as PLY of 3D Gaussian splatting, which its viewers open",
    ),
    Format(
        "field",
        (RUN,),
        ".npz",
        f"{_HERE}.field_file:write_field",
        (),
        "all parameters of a field of Gaussians in one file, without loss; `wrf-mi import` makes a run of it",
    ),
    Format(
        "paths",
        (RUN, SCENE),
        ".csv",
        f"{_HERE}.paths_table:write_paths",
        _TRACED,
        "paths of a traced run, or of a scene from --tx to --rx at --frequency, one row each",
    ),
    Format(
        "deepmimo",
        (RUN,),
        "",
        f"{_HERE}.paths_table:write_scenario",
        (),
        "paths of a traced run as a scenario of DeepMIMO, a folder",
    ),
    Format(
        "sionna",
        SCENES,
        "",
        f"{_HERE}.scenes:write_sionna",
        ("frequency_hz", "material"),
        "scene as a folder that sionna.rt.load_scene opens with the same materials, and mi.load_file for pictures",
    ),
    Format(
        "glb",
        SCENES,
        ".glb",
        f"{_HERE}.scenes:write_glb",
        ("material",),
        "scene as one glTF file (y up) with a mesh for each surface and a coloured material for each radio material",
    ),
    Format(
        "ply",
        SCENES,
        ".ply",
        f"{_HERE}.scenes:write_mesh",
        ("material",),
        "scene as one mesh (z up) with colour, material and surface of each face; `wrf-mi mesh` reads it",
    ),
    Format(
        "spectra",
        (DATASET,),
        "",
        f"{_HERE}.measurements:write_spectra",
        (),
        "spectra in the layout of NeRF2, a folder of images of 16 bits (docs/data.md)",
    ),
    Format(
        "ble",
        (DATASET,),
        "",
        f"{_HERE}.measurements:write_strengths",
        (),
        "signal strengths in the layout of flat-ble, a folder of CSV files",
    ),
    Format(
        "nerf2-csi",
        (DATASET,),
        "",
        f"{_HERE}.measurements:write_channels",
        (),
        "uplink and downlink of a base station in the layout of NeRF2, a folder",
    ),
    Format(
        "npz",
        (DATASET,),
        ".npz",
        f"{_HERE}.measurements:write_npz",
        (),
        "any data set in one file, without loss",
    ),
)

FORMATS = Registry[Format]("format", ENTRY_POINTS, {one.name: one for one in BUILT_IN})
"""All formats by name."""


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
    from .source import find_source  # imports tracer and models, which the list of formats does without

    asked, given = FORMATS[format], options or ExportOptions()
    asked.check(Path(out), given)
    found = find_source(source)
    if not set(found.kinds) & set(asked.kinds):
        others = [name for name, other in FORMATS.items() if set(other.kinds) & set(found.kinds)]
        text = f"{source}: a {' and '.join(found.kinds)}; format {format} takes a {' or a '.join(asked.kinds)}"
        raise InputError(f"{text}; choose from {', '.join(others)}")
    return asked.write(found.of(asked.kinds), Path(out), given)


__all__ = ["BUILT_IN", "DATASET", "ENTRY_POINTS", "FORMATS", "RUN", "SCENE", "ExportOptions", "Format", "export"]
