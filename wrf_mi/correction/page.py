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
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

from ..core.angles import FloatArray
from ..core.files import atomic_folder, listed, write_atomically, write_figure
from ..scene import drawing
from ..scene.correction_data import FILE
from ..scene.correction_data import KEY as DATA
from ..scene.mesh.surfaces import Kind
from ..tracing.paths.corrected_scene import moved_triangles, write_corrected_scene
from ..tracing.paths.scene_parameters import QUANTITIES, SHIFT, SURFACE, TILT, name_of
from .edits import Correction
from .options import FRAME, MATERIALS, PHASES
from .state import LEAST_PATHS, State, rigid_motion, scene_entries

PAGE, PICTURE = "correction.md", "correction.png"
SUPPORTED = 0.5  # largest ratio of standard deviations after and before at which a quantity counts as measured
CONSTANTS = ("permittivity", "conductivity", "thickness_m", "conductivity_exponent")
"""Constants of a material in ``correction.json``, each before and after."""
AS_STATED, FITTED, ANOTHER, LEFT_OUT = "as stated", "constants fitted", "another material", "left out"
CHANGES = {AS_STATED: "0.85", FITTED: "tab:blue", ANOTHER: "tab:orange", LEFT_OUT: "tab:red"}  # and colours


def write_page(correction: Correction, folder: str | Path, replace: bool = False) -> dict[str, Any]:
    """Write a corrected scene and its page atomically as a new scene folder; returns the content of its JSON file.

    Raises:
        InputError: a folder that exists and is not to be replaced, or cannot be written, or no surface is left.
    """
    facts = _facts(correction)
    with atomic_folder(Path(folder), replace=replace) as part:
        write_scene(correction.state, correction.kinds, part)
        plain = json.dumps(facts, indent=1, default=lambda x: x.tolist() if hasattr(x, "tolist") else str(x))
        write_atomically(part / FILE, plain + "\n")
        lines = [*_scores_text(correction, facts), *_frame_text(facts["frame"])]
        lines += _planes_text(facts["planes"]) if correction.kept else []
        lines += [*_materials_text(correction, facts["materials"]), *_limits_text(facts), ""]
        write_atomically(part / PAGE, "\n".join(lines))
        write_figure(part / PICTURE, _picture(correction, facts))
    return facts


def write_scene(state: State, kinds: Mapping[str, Kind], folder: Path) -> None:
    """Write a corrected scene without its page atomically, in place of what is there (InputError: no surface left).

    ``kinds`` are those of the objects of the stated scene.
    """
    opened = state.posterior.misfit.traced_fields[0].scene
    how: dict[str, Any] = {"kinds": kinds, "absent": state.absent(), "replace": True}
    write_corrected_scene(folder, opened, state.scene_parameters(), grouping="surface", **how)


def _facts(correction: Correction) -> dict[str, Any]:
    misfit, task = correction.misfit, correction.misfit.record.task
    changed = np.isin(np.arange(len(correction.vector)), correction.state.free)
    values, sd_before = misfit.named(correction.vector), correction.state.posterior.prior_deviation
    parameters = {
        name: {
            "value": values[name].ravel().tolist(),
            "sd": correction.deviation[span].tolist(),
            "sd_before": sd_before[span].tolist(),
            "changed": changed[span].tolist(),
        }
        for name, span in misfit.slices.items()
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
    misfit, surfaces = correction.misfit, correction.misfit.traced_fields[0].surfaces
    if SHIFT not in misfit.slices:
        return []
    shift, tilt = (misfit.slices[name] for name in (SHIFT, TILT))
    moved_mm, sd_mm = 1e3 * correction.vector[shift], 1e3 * correction.deviation[shift]
    turned, turned_sd = (1e3 * values[tilt].reshape(-1, 2) for values in (correction.vector, correction.deviation))
    # A quantity is measured where its standard deviation fell by half: the data then tell more than the prior.
    free = np.isin(np.arange(shift.start, shift.stop), correction.state.free)
    ratio = correction.deviation[shift] / correction.state.posterior.prior_deviation[shift]
    planes = []
    for place, (number, paths) in enumerate(zip(misfit.planes, misfit.counts()[0], strict=True)):
        objects = np.unique(surfaces.object_of(np.flatnonzero(surfaces.plane == number)))
        planes.append(
            {
                "objects": sorted(surfaces.names[thing] for thing in objects),
                "normal": surfaces.normal[number].round(4).tolist(),
                "paths": int(paths),
                "shift_mm": float(moved_mm[place]),
                "shift_sd_mm": float(sd_mm[place]) if free[place] else None,
                "tilt_mrad": turned[place].tolist(),
                "tilt_sd_mrad": turned_sd[place].tolist() if free[place] else None,
                "measured": bool(free[place] and ratio[place] <= SUPPORTED),
            }
        )
    return planes


def _materials(correction: Correction) -> list[dict[str, Any]]:
    """Each surface that paths meet: paths, constants before and after, standard deviations of their logarithms."""
    misfit, slabs, state = correction.misfit, correction.misfit.traced_fields[0].slabs, correction.state
    fitted = slabs.fitted(misfit.named(correction.vector)) if correction.kept else slabs
    # Constants, not their logarithms, which parameters are; their uncertainty is a factor.
    before, after = (np.column_stack([part.table, part.exponent]).tolist() for part in (slabs, fitted))
    changed, absent = state.free, state.absent()
    names = [name_of(SURFACE, quantity) for quantity in QUANTITIES[: 3 + misfit.several_carriers]]
    starts = np.array([misfit.slices[name].start for name in names if name in misfit.slices], int)
    materials = []
    for index, (name, paths) in enumerate(zip(slabs.names, misfit.counts()[1], strict=True)):
        sd: list[float] | None = None
        measured: list[bool] | None = None
        places = starts + index
        if np.isin(places[:1], changed).any():
            sd = correction.deviation[places].tolist()
            measured = (sd / state.posterior.prior_deviation[places] <= SUPPORTED).tolist()
        materials.append(
            {
                "surface": name.partition("/")[0],
                "paths": int(paths),
                "first_choice": state.materials.get(name),
                "absent": misfit.slabs[index] in absent,
                **dict(zip(CONSTANTS, map(list, zip(before[index], after[index], strict=True)), strict=True)),
                "sd_log": sd,
                "measured": measured,
            }
        )
    return materials


def _frame(correction: Correction) -> dict[str, Any] | None:
    misfit = correction.misfit
    if FRAME not in correction.kept.split("+"):
        return None
    surfaces, places = misfit.traced_fields[0].surfaces, misfit.plane_entries
    change, precision = np.zeros((2, 3 * len(surfaces.normal)))
    entries, free = scene_entries(misfit.planes, len(surfaces.normal)), np.isin(places, correction.state.free)
    # The motion nearest to all planes, each as certain as the fit knows it; planes that were not fitted do not count.
    change[entries] = correction.vector[places]
    precision[entries[free]] = 1 / np.square(correction.deviation[places[free]])
    motion, sd = (1e3 * values for values in rigid_motion(surfaces, change, precision))
    return {
        "translation_mm": motion[:3].tolist(),
        "translation_sd_mm": sd[:3].tolist(),
        "rotation_mrad": motion[3:].tolist(),
        "rotation_sd_mrad": sd[3:].tolist(),
    }


def _table(header: str, kinds: str, rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table, and a blank one: cells of ``header`` by "|", ``kinds`` l or r (numbers) of columns."""
    rules = " | ".join("---:" if kind == "r" else "---" for kind in kinds)
    return [f"| {header} |", f"| {rules} |", *(f"| {' | '.join(row)} |" for row in rows), ""]


def _scores_text(correction: Correction, facts: dict[str, Any]) -> list[str]:
    task, receivers = correction.misfit.record.task, listed(facts["held_out_receivers"])
    place = f"at the receivers {receivers}, which were held out" if receivers else "that were held out in clusters"
    scores = [
        (stage, *(f"{score[kind]:.{task.digits}f}" for kind in ("median", "mean")))
        for stage, score in facts["held_out_scores"].items()
    ]
    lines = [
        "# A scene corrected by measurements",
        "",
        f"Data: {correction.misfit.record.name}, {facts['rows']} training rows, {facts['paths']} paths. "
        f"Kept: {facts['kept']}. Duration: {facts['seconds']:.0f} s.",
        "",
        f"{task.label} of {facts['held_out']} training rows {place} while choosing:",
        "",
        *_table("scene | median | mean", "lrr", scores),
    ]
    if PHASES in correction.kept.split("+"):
        text = "No planes were resolved. Materials are those for which the channels are most probable with uncertain"
        lines += [f"{text} phases of paths: powers are calibrated, phases are wrong.", ""]
    if correction.data is not None:
        ratio = f"{correction.data.error_ratio:.2f}"
        lines += [f"Errors at rows that the scene does not know are about {ratio} times those at the rows above.", ""]
    return [*lines, f"![surfaces and scores]({PICTURE})", ""]


def _frame_text(frame: dict[str, Any] | None) -> list[str]:
    if frame is None:
        return []
    rows = [
        (f"{what} ({unit})", *map(_with_sd, frame[f"{what}_{unit}"], frame[f"{what}_sd_{unit}"]))
        for what, unit in (("translation", "mm"), ("rotation", "mrad"))
    ]
    table = _table("| x | y | z", "lrrr", rows)
    return ["## Frame", "", "Common motion of all planes, about the mean of their centres.", "", *table]


def _planes_text(planes: list[dict[str, Any]]) -> list[str]:
    rows = []
    for plane in sorted(planes, key=lambda plane: -plane["paths"]):
        if plane["shift_sd_mm"] is not None:
            names = listed(plane["objects"], 3)
            tilts = ", ".join(map(_with_sd, plane["tilt_mrad"], plane["tilt_sd_mrad"]))
            shift, measured = _with_sd(plane["shift_mm"], plane["shift_sd_mm"]), "yes" if plane["measured"] else "no"
            rows.append((names, str(plane["paths"]), shift, tilts, measured))
    header = "objects | paths | shift (mm) | tilts (mrad) | measured"
    return ["## Planes", "", *_table(header, "lrrrl", rows)] if rows else []


def _constant(name: str, value: float, sd: float, measured: bool) -> str:
    # The exponent is no logarithm.
    text, spread = f"{value:.3g}", f"x/ {math.exp(sd):.2g}"
    if name == CONSTANTS[-1]:
        text, spread = f"{value:.2f}", f"± {sd:.2f}"
    return f"{text} {spread}" if measured else f"({text})"


def _materials_text(correction: Correction, materials: list[dict[str, Any]]) -> list[str]:
    several, rows = correction.misfit.several_carriers, []
    for material in sorted(materials, key=lambda material: -material["paths"]):
        if material["sd_log"] is None:
            continue
        constants = zip(CONSTANTS, material["sd_log"], material["measured"], strict=False)
        cells = [_constant(name, material[name][1], sd, measured) for name, sd, measured in constants]
        choice = "absent, left out" if material["absent"] else material["first_choice"] or "as stated"
        rows.append((material["surface"], str(material["paths"]), choice, *cells))
    if not rows:
        return []
    law = " At another carrier f it is multiplied by (f / f0)^d." if several else ""
    hz = correction.state.posterior.frequency_hz
    text = (
        f"Conductivities hold at the carrier f0 = {hz / 1e9:.6g} GHz.{law} A constant in parentheses is not identified."
    )
    header = "surface | paths | chosen | permittivity | conductivity (S/m) | thickness (m)"
    table = _table(header + " | exponent d" * several, "lrlrrr" + "r" * several, rows)
    return ["## Materials", "", text, "", *table]


def _limits_text(facts: dict[str, Any]) -> list[str]:
    few = facts["surfaces"] - sum(material["sd_log"] is not None for material in facts["materials"])
    return [
        "## What the data do not tell",
        "",
        f"- {few} of {facts['surfaces']} surfaces are as stated: fewer than {LEAST_PATHS} paths meet them"
        f"{'' if MATERIALS in facts['kept'] else ', or no change of materials was kept'}.",
        f'- "Measured" are quantities whose standard deviation fell below {SUPPORTED:.0%} of the one before; '
        "`x/ 1.2` is a factor of one standard deviation.",
        "- Standard deviations are those of the Fisher information and the prior, with the paths of the scene that "
        "was found. Of surfaces that the scan missed, only faces of boxes are tried (`hidden`).",
    ]


def _with_sd(value: float, sd: float) -> str:
    return f"{value:.1f} ± {sd:.1f}" if math.isfinite(sd) else "not fixed by any plane"


def _changes_of_materials(correction: Correction, facts: dict[str, Any]) -> list[str]:
    """The change of the material of each face, a key of `CHANGES`."""
    of_slab = [AS_STATED] * facts["surfaces"]
    for index, material in zip(correction.misfit.slabs, facts["materials"], strict=True):
        if material["sd_log"] is not None:
            of_slab[index] = LEFT_OUT if material["absent"] else ANOTHER if material["first_choice"] else FITTED
    return [of_slab[slab] if slab >= 0 else AS_STATED for slab in correction.misfit.tables.slab_of_face]


def _picture(correction: Correction, facts: dict[str, Any]) -> Figure:
    """The scene coloured by the shifts of its planes, or where none moved by its materials, and the held-out scores."""
    surfaces = correction.misfit.traced_fields[0].surfaces
    parameters = correction.state.scene_parameters()
    triangles = moved_triangles(surfaces, parameters)
    shift = np.zeros(len(surfaces.normal)) + 1e3 * parameters.get(SHIFT, 0.0)
    figure = Figure(figsize=(12, 5.2), layout=ConstrainedLayoutEngine(wspace=0.12))  # labels of z need room
    room: Any = figure.add_subplot(1, 2, 1, projection="3d")
    # Ceilings would hide the room.
    above = [correction.kinds.get(name) == "ceiling" for name in surfaces.names]
    shown = ~np.array(above)[surfaces.object_of(np.arange(len(triangles)))]
    if not any(plane["shift_mm"] for plane in facts["planes"]):
        label, which = "materials of surfaces", _changes_of_materials(correction, facts)
        colours = np.array([to_rgba(CHANGES[change], alpha=0.45) for change in which])[shown]
        handles = [Patch(color=colour, alpha=0.45, label=change) for change, colour in CHANGES.items()]
        # At a fixed place: the best one is searched for among all corners of all faces.
        room.legend(handles=handles, fontsize=8, loc="upper left")
    else:
        label, most = "shifts of planes along their normals", max(1.0, float(np.abs(shift).max()))
        shifts = ScalarMappable(Normalize(-most, most), "RdBu")  # signed: planes that stayed are white
        colours = shifts.to_rgba(shift[surfaces.plane][shown], alpha=0.45)
        drawing.colour_bar(figure, shifts, room, "shift (mm)", shrink=0.6, pad=0.14)
    drawing.draw_faces(room, triangles[shown], colours, edgecolors="0.4", linewidths=0.3, antialiaseds=True)
    room.plot(*correction.misfit.record.tx_pos_m[correction.misfit.rows].T, ",", color="0.2")
    drawing.draw_devices(room, "receiver", [receiver.position_m for receiver in correction.misfit.receivers])
    drawing.set_box(room, triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1)))
    room.set_title(label)
    _plot_scores(figure.add_subplot(1, 2, 2), correction)
    return figure


def _plot_scores(axes: Any, correction: Correction) -> None:
    # Distributions over the held-out rows: a mean that gains may hide rows that lose.
    for stage, score in correction.scores.items():
        values: FloatArray = np.sort(score[np.isfinite(score)])
        share = np.arange(1, len(values) + 1) / max(len(values), 1)
        style = "-" if stage == correction.kept else "--"
        axes.step(values, share, style, where="post", label=f"{_stage(stage)}{' (kept)' if style == '-' else ''}")
    axes.set(xlabel=correction.misfit.record.task.label, ylabel="share of the held-out rows", ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
