"""A corrected scene as a folder: scene, page, picture and figures.

The folder is a scene folder (`wrf_mi.scene.folder`), which plain Sionna RT and Mitsuba open, with three files more:

correction.md    what was changed, by how much, how certain it is, and the scores before and after
correction.json  the same for programs, all parameters among them
correction.png   the scene, coloured by how far its surfaces were moved or how their materials changed, and the scores
                 of the held-out rows
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from ..core.angles import FloatArray
from ..core.files import atomic_folder, write_atomically, write_figure
from ..scene.correction_data import FILE
from ..scene.correction_data import KEY as DATA
from ..tasks import task_of
from ..tracing.paths.corrected_scene import moved_triangles, write_corrected_scene
from ..tracing.paths.material_parameters import QUANTITIES, SURFACE, name_of
from ..tracing.paths.plane_parameters import SHIFT, TILT
from .correct import Correction
from .fit import LEAST_PATHS
from .frame import rigid_motion, scene_entries
from .options import FRAME, MATERIALS

PAGE, PICTURE = "correction.md", "correction.png"
SUPPORTED = 0.5
"""Largest ratio of standard deviations after and before the correction at which a quantity counts as measured."""
AS_STATED, FITTED, ANOTHER, LEFT_OUT = "as stated", "constants fitted", "another material", "left out"
CHANGES = {AS_STATED: "0.85", FITTED: "tab:blue", ANOTHER: "tab:orange", LEFT_OUT: "tab:red"}
"""Colours of the changes of materials."""


def write_page(correction: Correction, folder: str | Path, replace: bool = False) -> dict[str, Any]:
    """Write a corrected scene and its page atomically.

    Args:
        correction: from `wrf_mi.correction.correct_scene`.
        folder: the new scene folder.
        replace: replace an existing folder.

    Returns:
        The content of ``correction.json``.

    Raises:
        InputError: a folder that exists or cannot be written, or no surface is left.
    """
    facts = _facts(correction)
    with atomic_folder(Path(folder), replace=replace) as part:
        write_corrected_scene(
            part,
            correction.misfit.sides[0].scene,
            correction.fit.of_scene(correction.state),
            grouping="surface",
            kinds=correction.kinds,
            absent=correction.fit.absent(correction.state),
            replace=True,
        )
        write_atomically(part / FILE, json.dumps(facts, indent=1, default=_plain) + "\n")
        write_atomically(part / PAGE, _text(correction, facts))
        write_figure(part / PICTURE, _picture(correction, facts))
    return facts


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _facts(correction: Correction) -> dict[str, Any]:
    """Everything that the page states."""
    misfit, task = correction.misfit, task_of(correction.misfit.record)
    changed = np.zeros(len(correction.vector), bool)
    changed[correction.fit.free(correction.kept)] = True
    values, parameters = misfit.named(correction.vector), {}
    for name, part in misfit.parts.items():
        parameters[name] = {
            "value": values[name].ravel().tolist(),
            "sd": correction.deviation[part].tolist(),
            "sd_before": correction.fit.prior_deviation[part].tolist(),
            "changed": changed[part].tolist(),
        }
    scores = {
        _stage(stage): {"mean": float(np.nanmean(score)), "median": float(np.nanmedian(score))}
        for stage, score in correction.scores.items()
    }
    return {
        "task": task.name,
        "score": task.label,
        "kept": _stage(correction.kept),
        "held_out_scores": scores,
        "seconds": correction.seconds,
        **correction.facts,
        DATA: correction.data and correction.data.facts(),
        "frame": _frame(correction),
        "surfaces": len(misfit.tables.slabs.names),
        "planes": _planes(correction),
        "materials": _materials(correction),
        "parameters": parameters,
    }


def _stage(stage: str) -> str:
    return stage.replace("+", ", ") or "as stated"


def _planes(correction: Correction) -> list[dict[str, Any]]:
    """Each plane that paths meet: objects, paths, movement and its standard deviation."""
    misfit, surfaces = correction.misfit, correction.misfit.sides[0].surfaces
    if SHIFT not in misfit.parts:
        return []
    count, paths = len(misfit.planes), misfit.counts()[0]
    faces = np.flatnonzero(np.isin(surfaces.plane, misfit.planes))
    objects = [set[str]() for _ in range(count)]
    for place, thing in zip(
        np.searchsorted(misfit.planes, surfaces.plane[faces]), surfaces.object_of(faces), strict=True
    ):
        objects[place].add(surfaces.names[thing])
    shift, tilt = (misfit.parts[name] for name in (SHIFT, TILT))
    turned = correction.vector[tilt].reshape(count, 2)
    turned_sd = correction.deviation[tilt].reshape(count, 2)
    free = np.isin(np.arange(shift.start, shift.stop), correction.fit.free(correction.kept))
    ratio = correction.deviation[shift] / correction.fit.prior_deviation[shift]
    return [
        {
            "objects": sorted(objects[plane]),
            "normal": surfaces.normal[misfit.planes[plane]].round(4).tolist(),
            "paths": int(paths[plane]),
            "shift_mm": 1e3 * float(correction.vector[shift][plane]),
            "shift_sd_mm": 1e3 * float(correction.deviation[shift][plane]) if free[plane] else None,
            "tilt_mrad": (1e3 * turned[plane]).tolist(),
            "tilt_sd_mrad": (1e3 * turned_sd[plane]).tolist() if free[plane] else None,
            "measured": bool(free[plane] and ratio[plane] <= SUPPORTED),
        }
        for plane in range(count)
    ]


def _materials(correction: Correction) -> list[dict[str, Any]]:
    """Each surface that paths meet: paths, constants before and after, standard deviations of their logarithms."""
    misfit, slabs = correction.misfit, correction.misfit.sides[0].slabs
    paths = misfit.counts()[1]
    fitted = slabs.fitted(misfit.named(correction.vector)) if correction.kept else slabs
    before, after = slabs.table, fitted.table
    changed, absent = correction.fit.free(correction.kept), correction.fit.absent(correction.state)
    quantities = QUANTITIES if misfit.several_carriers else QUANTITIES[:3]
    parts = [misfit.parts.get(name_of(SURFACE, quantity)) for quantity in quantities]
    found = []
    for index, name in enumerate(slabs.names):
        places = [part.start + index for part in parts if part is not None]
        free = bool(places) and places[0] in changed
        sd = correction.deviation[places] if free else None
        found.append(
            {
                "surface": name.partition("/")[0],
                "paths": int(paths[index]),
                "first_choice": correction.state.materials.get(name),
                "absent": misfit.slabs[index] in absent,
                "permittivity": [float(before[index, 0]), float(after[index, 0])],
                "conductivity": [float(before[index, 1]), float(after[index, 1])],
                "thickness_m": [float(before[index, 2]), float(after[index, 2])],
                "conductivity_exponent": [float(slabs.exponent[index]), float(fitted.exponent[index])],
                "sd_log": None if sd is None else sd.tolist(),
                "measured": None if sd is None else (sd / correction.fit.prior_deviation[places] <= SUPPORTED).tolist(),
            }
        )
    return found


def _frame(correction: Correction) -> dict[str, Any] | None:
    """The common motion of the planes, and its standard deviations."""
    misfit = correction.misfit
    if FRAME not in correction.kept.split("+"):
        return None
    surfaces, places = misfit.sides[0].surfaces, misfit.plane_entries
    change, precision = np.zeros((2, 3 * len(surfaces.normal)))
    entries, free = (
        scene_entries(misfit.planes, len(surfaces.normal)),
        np.isin(places, correction.fit.free(correction.kept)),
    )
    change[entries] = correction.vector[places]
    precision[entries[free]] = 1 / np.square(correction.deviation[places[free]])
    motion, sd = rigid_motion(surfaces, change, precision)
    return {
        "translation_mm": (1e3 * motion[:3]).tolist(),
        "translation_sd_mm": (1e3 * sd[:3]).tolist(),
        "rotation_mrad": (1e3 * motion[3:]).tolist(),
        "rotation_sd_mrad": (1e3 * sd[3:]).tolist(),
    }


def _text(correction: Correction, facts: dict[str, Any]) -> str:
    """The page as Markdown."""
    task = task_of(correction.misfit.record)
    receivers = ", ".join(facts["held_out_receivers"])
    held = f"at the receivers {receivers}, which were held out" if receivers else "that were held out in clusters"
    lines = [
        "# A scene corrected by measurements",
        "",
        f"Data: {correction.misfit.record.name}, {facts['rows']} training rows, {facts['paths']} paths. "
        f"Kept: {facts['kept']}. Duration: {facts['seconds']:.0f} s.",
        "",
        f"{task.label} of {facts['held_out']} training rows {held} while choosing:",
        "",
        "| scene | median | mean |",
        "| --- | ---: | ---: |",
    ]
    for stage, score in facts["held_out_scores"].items():
        lines.append(f"| {stage} | {score['median']:.{task.digits}f} | {score['mean']:.{task.digits}f} |")
    if correction.data is not None:
        ratio = f"{correction.data.error_ratio:.2f}"
        lines += ["", f"Errors at rows that the scene does not know are about {ratio} times those at the rows above."]
    lines += ["", f"![surfaces and scores]({PICTURE})", ""]
    if (frame := facts["frame"]) is not None:
        lines += ["## Frame", "", "Common motion of all planes, about the mean of their centres.", ""]
        lines += ["| | x | y | z |", "| --- | ---: | ---: | ---: |"]
        for what, unit in (("translation", "mm"), ("rotation", "mrad")):
            pairs = zip(frame[f"{what}_{unit}"], frame[f"{what}_sd_{unit}"], strict=True)
            lines.append(f"| {what} ({unit}) | " + " | ".join(_with_sd(*pair) for pair in pairs) + " |")
        lines.append("")
    known = [plane for plane in facts["planes"] if plane["shift_sd_mm"] is not None]
    if known and correction.kept:
        lines += ["## Planes", "", "| objects | paths | shift (mm) | tilts (mrad) | measured |"]
        lines.append("| --- | ---: | ---: | ---: | --- |")
        for plane in sorted(known, key=lambda plane: -plane["paths"]):
            tilts = ", ".join(_with_sd(*pair) for pair in zip(plane["tilt_mrad"], plane["tilt_sd_mrad"], strict=True))
            shift = _with_sd(plane["shift_mm"], plane["shift_sd_mm"])
            names = ", ".join(plane["objects"][:3]) + (" ..." if len(plane["objects"]) > 3 else "")
            lines.append(f"| {names} | {plane['paths']} | {shift} | {tilts} | {'yes' if plane['measured'] else 'no'} |")
        lines.append("")
    fitted = [one for one in facts["materials"] if one["sd_log"] is not None]
    if fitted:
        several, hz = correction.misfit.several_carriers, correction.fit.frequency_hz
        law = " At another carrier f it is multiplied by (f / f0)^d." if several else ""
        text = f"Conductivities hold at the carrier f0 = {hz / 1e9:.6g} GHz.{law} A constant in parentheses is not"
        lines += ["## Materials", "", f"{text} identified."]
        more = " exponent d |" if several else ""
        lines += ["", f"| surface | paths | chosen | permittivity | conductivity (S/m) | thickness (m) |{more}"]
        lines.append("| --- | ---: | --- | ---: | ---: | ---: |" + " ---: |" * several)
        for one in sorted(fitted, key=lambda one: -one["paths"]):
            cells = []
            keys = "permittivity", "conductivity", "thickness_m"
            for key, sd, sure in zip(keys, one["sd_log"], one["measured"], strict=False):
                value = f"{one[key][1]:.3g}" + (f" x/ {math.exp(sd):.2g}" if sure else "")
                cells.append(value if sure else f"({value})")
            if several:
                exponent, sd = one["conductivity_exponent"][1], one["sd_log"][-1]
                cells.append(f"{exponent:.2f} ± {sd:.2f}" if one["measured"][-1] else f"({exponent:.2f})")
            taken = "absent, left out" if one["absent"] else one["first_choice"] or "as stated"
            lines.append(f"| {one['surface']} | {one['paths']} | {taken} | " + " | ".join(cells) + " |")
        lines.append("")
    few = facts["surfaces"] - len(fitted)
    lines += [
        "## What the data do not tell",
        "",
        f"- {few} of {facts['surfaces']} surfaces are as stated: fewer than {LEAST_PATHS} paths meet them"
        f"{'' if MATERIALS in facts['kept'] else ', or no change of materials was kept'}.",
        f'- "Measured" are quantities whose standard deviation fell below {SUPPORTED:.0%} of the one before; '
        "`x/ 1.2` is a factor of one standard deviation.",
        "- Standard deviations are those of the Fisher information and the prior, with the paths of the scene that "
        "was found. Of surfaces that the scan missed, only faces of boxes are tried (`hidden`).",
        "",
    ]
    return "\n".join(lines)


def _with_sd(value: float, sd: float) -> str:
    return f"{value:.1f} ± {sd:.1f}" if math.isfinite(sd) else "not fixed by any plane"


def _changes_of_materials(correction: Correction, facts: dict[str, Any]) -> list[str]:
    """The change of the material of each face, a key of `CHANGES`."""
    of_slab = [AS_STATED] * facts["surfaces"]
    for index, one in zip(correction.misfit.slabs, facts["materials"], strict=True):
        if one["sd_log"] is not None:
            of_slab[index] = LEFT_OUT if one["absent"] else ANOTHER if one["first_choice"] else FITTED
    return [of_slab[slab] if slab >= 0 else AS_STATED for slab in correction.misfit.tables.slab_of_face]


def _picture(correction: Correction, facts: dict[str, Any]) -> Figure:
    """The scene coloured by the shifts of its planes, or where none moved by its materials, and the held-out scores."""
    surfaces = correction.misfit.sides[0].surfaces
    parameters = correction.fit.of_scene(correction.state)
    triangles = moved_triangles(surfaces, parameters)
    shift = np.zeros(len(surfaces.normal)) + 1e3 * parameters.get(SHIFT, 0.0)
    figure = Figure(figsize=(12, 5.2), layout=ConstrainedLayoutEngine(wspace=0.12))  # labels of z need room
    room: Any = figure.add_subplot(1, 2, 1, projection="3d")
    above = [correction.kinds.get(name) == "ceiling" for name in surfaces.names]
    shown = ~np.array(above)[surfaces.object_of(np.arange(len(triangles)))]
    if not any(plane["shift_mm"] for plane in facts["planes"]):
        label, which = "materials of surfaces", _changes_of_materials(correction, facts)
        colours = np.array([to_rgba(CHANGES[one], alpha=0.45) for one in which])[shown]
        handles = [Patch(color=CHANGES[one], alpha=0.45, label=one) for one in CHANGES]
        # At a fixed place: the best one is searched for among all corners of all faces.
        room.legend(handles=handles, fontsize=8, loc="upper left")
    else:
        label, most = "shifts of planes along their normals", max(1.0, float(np.abs(shift).max()))
        shades = ScalarMappable(Normalize(-most, most), "RdBu")
        colours = shades.to_rgba(shift[surfaces.plane][shown], alpha=0.45)
        figure.colorbar(shades, ax=room, shrink=0.6, pad=0.14, label="shift (mm)")
    room.add_collection3d(Poly3DCollection(triangles[shown], facecolors=colours, edgecolors="0.4", linewidths=0.3))
    room.plot(*correction.misfit.record.tx_pos_m[correction.misfit.rows].T, ",", color="0.2")
    for receiver in correction.misfit.receivers:
        room.plot(*np.asarray(receiver.position_m)[:, None], "^", color="C1")
    low, high = triangles.reshape(-1, 3).min(axis=0), triangles.reshape(-1, 3).max(axis=0)
    for axis, a, b in zip("xyz", low, high, strict=True):
        room.set(**{f"{axis}lim": (a, b), f"{axis}label": f"{axis} (m)"})
    room.set_box_aspect(np.maximum(high - low, 0.1))
    room.set_title(label)
    axes = figure.add_subplot(1, 2, 2)
    for stage, score in correction.scores.items():
        values: FloatArray = np.sort(score[np.isfinite(score)])
        share = np.arange(1, len(values) + 1) / max(len(values), 1)
        style = "-" if stage == correction.kept else "--"
        axes.step(values, share, style, where="post", label=f"{_stage(stage)}{' (kept)' if style == '-' else ''}")
    axes.set(xlabel=task_of(correction.misfit.record).label, ylabel="share of the held-out rows", ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure
