"""``wrf-mi map``, ``plan``, ``locate`` and ``view``: maps, further measurements, positions and views of runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from ...core import InputError
from .options import Arguments, add_command, add_own, add_scheduler, refuse
from .output import Watch, show, summary_table


def add_parser(commands: Any) -> None:
    """Add ``map``, ``plan``, ``locate`` and ``view`` to the commands."""
    for add in (_add_map, _add_plan, _add_locate, _add_view):
        add(commands)


def _add_map(commands: Any) -> None:
    text = "map power, coverage and best receiver over a plane or a mesh"
    parser = add_command(commands, "map", map_command, text)
    add = parser.add_argument
    add("run", metavar="RUN", help="run folder")
    add("--out", required=True, metavar="FILE", help="file to write: MAP.nc, MAP.zarr or MAP.csv; beside it MAP.png")
    text = "z of the transmitter, metres (default: the median of the data's); with --surface: above it (default: 0)"
    add("--height", type=float, metavar="M", help=text)
    text = "mesh whose faces' centres are the positions, in place of the grid (PLY, STL, OBJ, GLB; metres)"
    add("--surface", metavar="MESH", help=text)
    text = "spacing of the grid (default: 0.1 m, more above a hectare), or longest edge of a mesh's faces, to be halved"
    add("--step", type=float, metavar="M", help=text)
    text = "name of a receiver, repeatable (default: all)"
    add("--receiver", action="append", metavar="NAME", help=text)
    text = "received power above which a position is covered, dBm (default: -90; in dB for spectra, where none is set)"
    add("--threshold", type=float, metavar="DBM", help=text)
    text = "transmit power, dBm: what path gain and received power differ by (default: 0)"
    add("--transmit-power", type=float, default=0.0, metavar="DBM", help=text)
    text = "yaw of the transmitter, degrees, for models that know it (default: mean over 8 headings)"
    add("--heading", type=float, metavar="DEG", help=text)
    add("--frequency", type=float, metavar="HZ", help="carrier, where the data have several")
    add_own(parser)
    add_scheduler(parser)


def map_command(a: Arguments) -> int:
    """Write a radio map and its picture."""
    from ...core.files import write_figure
    from ...parallel import open_scheduler
    from ...runs.run import open_run
    from ..maps.api import radio_map
    from ..maps.dataset import check_map_file, write_map
    from ..maps.locate_file import device_text, read_own
    from ..maps.picture import map_figure

    out = Path(a.out)
    check_map_file(out)
    run = open_run(a.run) if a.own is None else read_own(open_run(a.run), a.own)
    options = {"height_m": a.height, "step_m": a.step, "surface": a.surface, "receivers": a.receiver}
    options |= {"threshold_dbm": a.threshold, "transmit_dbm": a.transmit_power}
    options |= {"heading_deg": a.heading, "frequency_hz": a.frequency}
    with Watch() as watch, open_scheduler(a.scheduler) as scheduler:
        workers = scheduler if a.scheduler else None
        dataset = radio_map(run, **options, on_progress=watch.on_progress, scheduler=workers)
    write_map(dataset, out)
    picture = write_figure(out.with_suffix(".png"), map_figure(dataset, run))
    if "power_std_db" not in dataset:
        print("no coverage: the model states no standard deviation; train with --intervals", file=sys.stderr)
    sizes = {str(name): int(dataset.sizes[name]) for name in ("receiver", "y", "x", "point") if name in dataset.sizes}
    names = [str(name) for name in dataset.data_vars]
    shape = " x ".join(str(count) for name, count in sizes.items() if name != "receiver")
    text = f"{device_text(run)}{shape} positions, {sizes['receiver']} receivers: {out}\npicture: {picture}"
    return show(a.json, {"out": str(out), "picture": str(picture), "sizes": sizes, "variables": names}, text)


def _add_plan(commands: Any) -> None:
    text = "positions to measure next, each as far as possible from all measured or planned before it"
    parser = add_command(commands, "plan", plan_command, text)
    add = parser.add_argument
    add("run", metavar="RUN", help="run folder")
    text = "file to write: order, x, y, z, distance from the nearest position before; FILE.png beside it"
    add("--out", required=True, metavar="FILE.csv", help=text)
    add("--count", type=int, default=10, metavar="N", help="number of positions (default: 10)")
    text = "positions that can be measured, x, y, z in metres, with a header (default: the map, 0.5 m from walls)"
    add("--candidates", metavar="FILE.csv", help=text)
    text = "corners of the area to measure in, metres (default: the scene, or the box of all rows of the data)"
    add("--area", type=float, nargs=4, metavar=("X0", "Y0", "X1", "Y1"), help=text)
    add("--step", type=float, metavar="M", help="spacing of the map (default: 0.25 m, more for large areas)")
    add("--height", type=float, metavar="M", help="height of the transmitter (default: the median of the data's)")


def plan_command(a: Arguments) -> int:
    """Write planned positions to a file, and a picture beside it."""
    from ...core.files import write_figure
    from ...runs.prediction_file import read_inputs
    from ...runs.run import open_run
    from ..maps.plan import plan
    from ..maps.plan_picture import plan_figure, summary

    out = Path(a.out)
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out}: positions are written as .csv; give such a name")
    run = open_run(a.run)
    candidates_m = None if a.candidates is None else read_inputs(a.candidates, None).tx_pos_m
    area_m = None if a.area is None else (a.area[:2], a.area[2:])
    planned = plan(run, a.count, candidates_m=candidates_m, area_m=area_m, step_m=a.step, height_m=a.height)
    planned.write(out)
    picture, text = write_figure(out.with_suffix(".png"), plan_figure(planned, run)), summary(planned)
    text += "\norder      x      y      z  (m)\n"
    for order, place in enumerate(planned.tx_pos_m, start=1):
        text += f"{order:5d}" + "".join(f"{value:7.2f}" for value in place) + "\n"
    figures = {"out": str(out), "picture": str(picture), "distance_m": planned.distance_m.round(2).tolist()}
    figures["positions_m"] = planned.tx_pos_m.round(2).tolist()
    return show(a.json, figures, f"{text}positions: {out}\npicture: {picture}")


def _add_locate(commands: Any) -> None:
    parser = add_command(commands, "locate", locate_command, "position of a transmitter from what receivers received")
    add = parser.add_argument
    add("run", metavar="RUN", help="run folder of a model of signal strengths that states standard deviations")
    text = "signal strengths: a column RECEIVER_dbm or rssi_RECEIVER for each receiver, empty where nothing was "
    text += "received, and true positions x, y in metres if known; or a table as of data import (default: test rows)"
    add("--observed", metavar="FILE", help=text)
    text = "file to write: estimate x, y, z, radius and area of the region, nearest neighbours; FILE.png beside it"
    add("--out", required=True, metavar="FILE.csv", help=text)
    text = "also write the probability of each position: arrays x_m, y_m, height_m, probability"
    add("--posterior", metavar="FILE.npz", help=text)
    add("--level", type=float, default=0.9, metavar="P", help="probability that regions hold (default: 0.9)")
    add("--step", type=float, metavar="M", help="distance between positions (default: 0.25 m, more for large areas)")
    add("--height", type=float, metavar="M", help="height of the transmitters (default: that of the run's data)")
    text = "standard deviation of the transmitter's power about that of the data (default: chosen by held-out rows)"
    add("--offset", type=float, metavar="DB", help=text)
    add_own(parser)


def locate_command(a: Arguments) -> int:
    """Write positions to a file, and a picture beside it."""
    from ...core.array_files import write_arrays
    from ...core.files import write_figure
    from ..maps import locate_file as files
    from ..maps.locate import locate, located_run

    out = Path(a.out)
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out}: positions are written as .csv; give such a name")
    if a.posterior is not None and Path(a.posterior).suffix.lower() != ".npz":
        raise InputError(f"{a.posterior}: probabilities are written as .npz; give such a name")
    run = located_run(a.run)
    if a.own is not None:
        run = files.read_own(run, a.own)
    if a.observed is not None:
        strengths_dbm, true_m = files.read_observations(
            a.observed, run.receivers, run.config.left_out, run.problem.record.source
        )
    else:
        strengths_dbm, true_m = files.test_observations(run)
    options = {"step_m": a.step, "height_m": a.height, "level": a.level, "offset_db": a.offset}
    with Watch(resumable=True) as watch:
        located = locate(run, strengths_dbm, **options, on_progress=watch.on_progress, stop=watch.stop)
    picture = out.with_suffix(".png")
    files.write_positions_file(out, located, true_m)
    write_figure(picture, files.draw_positions(run, located, true_m))
    if a.posterior is not None:
        write_arrays(Path(a.posterior), files.posterior_arrays(located), compressed=True)
    figures = files.figures_of(located, true_m)
    text = f"{files.device_text(run)}{_summary(figures)}\n{len(located)} positions: {out}\npicture: {picture}"
    return show(a.json, {"out": str(out), "picture": str(picture), **figures}, text)


def _summary(figures: dict[str, Any]) -> str:
    form, held_out = figures["likelihood"], figures.get("held_out")
    text = f"likelihood: {form['scale']:g} of the stated standard deviations"
    text += f", common offset of {form['offset_db']:g} dB" if form["offset_db"] else ""
    if figures["neighbours_spread_m"] is not None:
        text += f", times a density of {figures['neighbours_spread_m']:.2g} m around the nearest neighbours' estimate"
    if held_out is None:
        text += " (default: the run has too few training rows to hold any out)"
    else:
        what = f"{held_out['rows']} training rows, held out {held_out['folds']}"
        near = f"nearest neighbours {held_out['neighbours_error_m']:.2f} m"
        text += (
            f"\nchosen by {what}: mean error {held_out['error_m']:.2f} m, {near}; regions of 90 % of the probability "
        )
        text += f"hold {held_out['inside']:.0%} of them, so that those of {figures['level']:.0%} of the positions have "
        text += f"{figures['region_mass']:.0%}"
    level = f"{figures['level']:.0%}"
    columns = {f"area of the {level} region (m2)": figures["area_m2"], f"radius of {level} (m)": figures["radius_m"]}
    columns["error (m)"] = figures.get("error_m")
    if "neighbours" in figures:
        columns[f"error of {figures['neighbours']['count']} nearest neighbours (m)"] = figures.get("neighbours_error_m")
    text += "\n" + summary_table(f"{figures['n']} positions", columns, 2)
    if "inside" in figures:
        text += f"\n{figures['inside']:.0%} of the true positions lie inside the {level} regions"
    if "gain_on_neighbours_m" in figures:
        gain = figures["gain_on_neighbours_m"]
        text += f"\nmean error below that of nearest neighbours by {gain['value']:.2f} m "
        text += f"(95 % interval {gain['low']:.2f} to {gain['high']:.2f} m)"
    text += f"\nat the border of the searched area: {figures['at_border']} of {figures['n']} estimates; outside of it: "
    text += f"training rows {figures['training_rows_outside']}"
    return text + (f", true positions {figures['outside']}" if "outside" in figures else "")


def _add_view(commands: Any) -> None:
    text = "write an interactive 3D view of a run, a scene and maps: one HTML file that needs no network"
    parser = add_command(commands, "view", view_command, text)
    add = parser.add_argument
    text = "run folder; scene: name, folder, Mitsuba XML or mesh; map: NetCDF file or Zarr folder. Several are combined"
    add("sources", nargs="+", metavar="RUN|SCENE|MAP", help=text)
    add("--out", required=True, metavar="VIEW.html", help="file to write")
    text = "largest number of test rows whose observations, Gaussians' signals and paths are stored (default: 40)"
    add("--max-transmitters", type=int, metavar="N", help=text)
    add("--max-gaussians", type=int, metavar="N", help="largest number of Gaussians, the strongest (default: 1000)")
    text = "largest number of paths of each transmitter to each receiver, the strongest (default: 200)"
    add("--max-paths", type=int, metavar="N", help=text)
    add("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete (default: none)")


def view_command(a: Arguments) -> int:
    """Write a view."""
    from ..viewer.view import view

    out = Path(a.out)
    if out.is_dir():
        raise InputError(f"{out}: a folder; give the name of a file, such as {out / 'view.html'}")
    limits = {name: getattr(a, f"max_{name}") for name in ("transmitters", "gaussians", "paths")}
    limits = {name: value for name, value in limits.items() if value is not None}
    with Watch() as watch:
        how: dict[str, Any] = {"on_progress": watch.on_progress, "progress": sys.stderr.isatty()}
        page = view(*a.sources, **limits, material=a.material, **how)
    refuse(a, (f"max_{name}" for name in limits if name not in page.counts), "is of a layer that these sources lack")
    size = page.write(out).stat().st_size
    names = {name: name.replace("_", " ").replace("gaussians", "Gaussians") for name in page.counts}
    counted = ", ".join(f"{n} {names[name][: -1 if n == 1 else None]}" for name, n in page.counts.items())
    text = "\n".join([counted, *page.content.notes, f"view: {out} ({size / 1e6:.1f} MB)"])
    return show(a.json, {"out": a.out, "bytes": size, **page.counts, "notes": page.content.notes}, text)
