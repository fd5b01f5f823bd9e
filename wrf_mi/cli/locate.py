"""``wrf-mi locate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .options import Arguments, add_command
from .output import Watch, print_json


def add_parser(commands: Any) -> None:
    """Add ``locate`` to the commands."""
    parser = add_command(commands, "locate", locate_command, "position of a transmitter from what receivers received")
    add = parser.add_argument
    add("run", metavar="RUN", help="run folder of a model of signal strengths that states standard deviations")
    text = (
        "signal strengths: a column RECEIVER_dbm or rssi_RECEIVER for each receiver, empty where nothing was received, "
    )
    text += "and true positions x, y in metres if known (default: the test rows of the run)"
    add("--input", metavar="FILE.csv", help=text)
    text = "file to write: estimate x, y, z, radius and area of the region, nearest neighbours; FILE.png beside it"
    add("--out", required=True, metavar="FILE.csv", help=text)
    text = "also write the probability of each position: arrays x_m, y_m, height_m, probability"
    add("--posterior", metavar="FILE.npz", help=text)
    add("--level", type=float, default=0.9, metavar="P", help="probability that regions hold (default: 0.9)")
    add("--step", type=float, metavar="M", help="distance between positions (default: 0.25 m, more for large areas)")
    add("--height", type=float, metavar="M", help="height of the transmitters (default: that of the run's data)")
    text = "standard deviation of the transmitter's power about that of the data (default: chosen by held-out rows)"
    add("--offset", type=float, metavar="DB", help=text)


def locate_command(a: Arguments) -> int:
    """Write positions to a file, and a picture beside it."""
    from ..core import InputError
    from ..core.array_files import write_arrays
    from ..core.files import write_figure
    from ..maps.locate import locate, located_run
    from ..maps.locate_figure import draw_positions
    from ..maps.locate_file import (
        figures_of,
        posterior_arrays,
        read_observations,
        test_observations,
        write_positions_file,
    )

    out = Path(a.out)
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out}: positions are written as .csv; give such a name")
    if a.posterior is not None and Path(a.posterior).suffix.lower() != ".npz":
        raise InputError(f"{a.posterior}: probabilities are written as .npz; give such a name")
    run = located_run(a.run)
    strengths_dbm, true_m = (
        test_observations(run) if a.input is None else read_observations(a.input, run.receivers, run.config.left_out)
    )
    options = {"step_m": a.step, "height_m": a.height, "level": a.level, "offset_db": a.offset}
    with Watch(resumable=True) as watch:
        found = locate(run, strengths_dbm, **options, on_progress=watch.on_progress, stop=watch.stop)
    picture = out.with_suffix(".png")
    write_positions_file(out, found, true_m)
    write_figure(picture, draw_positions(run, found, true_m))
    if a.posterior is not None:
        write_arrays(Path(a.posterior), posterior_arrays(found), compressed=True)
    figures = figures_of(found, true_m)
    if a.json:
        print_json({"out": str(out), "picture": str(picture), **figures})
        return 0
    _show(figures)
    print(f"{len(found)} positions: {out}\npicture: {picture}")
    return 0


def _show(figures: dict[str, Any]) -> None:
    form, held = figures["likelihood"], figures.get("held_out")
    shape = "normal" if form["degrees"] is None else f"Student-t of {form['degrees']:g} degrees of freedom"
    text = f"likelihood: {shape}, {form['scale']:g} of the stated standard deviations"
    text += f", common offset of {form['offset_db']:g} dB" if form["offset_db"] else ""
    text += ", receivers that received nothing count" if form["silence"] else ""
    if held is None:
        print(f"{text} (default: the run has too few training rows to hold any out)")
    else:
        share = f"{held['inside']:.0%} inside their 90 % regions"
        what = f"{held['rows']} predictions of held-out training rows"
        print(f"{text}, chosen by {what}: {share}, mean error {held['error_m']:.2f} m")
    title = f"{figures['n']} positions"
    print(f"{title:<36}{'median':>8}{'mean':>8}{'p10':>8}{'p90':>8}")
    known = {
        f"area of the {figures['level']:.0%} region (m2)": figures["area_m2"],
        f"radius of {figures['level']:.0%} (m)": figures["radius_m"],
        "error (m)": figures.get("error_m"),
    }
    if "neighbours" in figures:
        known[f"error of {figures['neighbours']['count']} nearest neighbours (m)"] = figures.get("neighbours_error_m")
    for name, block in known.items():
        if block is not None:
            print(f"{name:<36}" + "".join(f"{block[key]:8.2f}" for key in ("median", "mean", "p10", "p90")))
    if "inside" in figures:
        print(f"{figures['inside']:.0%} of the true positions lie inside the {figures['level']:.0%} regions")
