"""The journey of the project's README: a plan and a walk become a map and positions, by five commands.

``mall-f3`` is a floor of a shopping centre: its plan in GeoJSON, and Wi-Fi strengths along walks, of which some are
held out. The figures are stored, and the picture is drawn from the files that the commands write.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import wrf_mi
from wrf_mi.core.files import write_figure
from wrf_mi.datasets.folder_files import read_csv
from wrf_mi.runs.folder import load_rows
from wrf_mi.runs.scene_view import scene_cuts
from wrf_mi.scene import drawing

from .bench import BenchFailed
from .buildings import MALL, source_folder
from .comparison import line, say
from .declared import lined
from .sources import fit_key, source_files

COMMANDS = (
    "mesh mall-f3/geojson_map.json --wall-height 4 --out runs/mall",
    "data import mall-f3/train.csv --test mall-f3/test.csv --min-rows 60 --out runs/walks",
    "train runs/walks --scene runs/mall --preset fast --out runs/powers",
    "map runs/powers --step 2 --out runs/powers.nc",
    "locate runs/powers --out runs/positions.csv",
)
"""The commands of the README, without ``wrf-mi``."""
RUNS, PICTURE = Path("runs/bench/journey"), Path("docs/images/front-page.png")


def travel(place: Path) -> dict[str, Any]:
    """Run the commands into a folder; what each prints by its first word, as ``--json`` has it."""
    printed = {}
    for number, words in enumerate(COMMANDS, 1):
        say("journey", f"{number} of {len(COMMANDS)}: wrf-mi {words}")
        put = words.replace("mall-f3/", f"{source_folder(MALL)}/").replace("runs/", f"{place}/").split()
        call = [sys.executable, "-m", "wrf_mi.apps.commands", *put, "--json"]
        done = subprocess.run(call, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            raise BenchFailed(f"journey: `wrf-mi {words}` ended with status {done.returncode}")
        printed[put[0]] = json.loads(done.stdout)
    return printed


def main() -> dict[str, Any]:
    """Figures of the journey, and its picture in a checkout."""
    source_folder(MALL)
    place = RUNS / fit_key(source_files())
    shutil.rmtree(place, ignore_errors=True)  # of a stopped journey, whose folders the commands would refuse
    place.mkdir(parents=True)
    printed = travel(place)
    metrics, positions = printed["train"], printed["locate"]
    idw, located = metrics["reference"]["idw"], positions["error_m"]
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, picture(place))
    powers = {"median": metrics["abs_error_db"]["median"], "idw": idw["median"], "inside_90": metrics["inside_90"]}
    places = {"median_m": located["median"], "neighbours_m": positions["neighbours_error_m"]["median"]}
    rows = [
        line("received power on walks that are held out", f"{powers['median']:.2f} dB", f"IDW {powers['idw']:.2f} dB"),
        line("positions on these walks", f"{places['median_m']:.1f} m", f"kNN {places['neighbours_m']:.1f} m"),
    ]
    return {"rows": rows, **powers, **places, "n_train": metrics["n_train"], "n_test": metrics["n_test"]}


table = lined("| median error | hybrid | interpolation |", "| {what} | {value} | {asked} |")


def picture(place: Path) -> Figure:
    """Plan and walks, predicted power at the receiver that was heard most, its deviation, and a located phone."""
    run, grid = wrf_mi.open_run(place / "powers"), xarray.load_dataset(place / "powers.nc")
    record = run.problem.record
    rows = load_rows(run.folder, record).all_train
    number = int(np.isfinite(record.observation[:, rows]).sum(axis=1).argmax())
    receiver = record.receivers[number]
    shown = grid.sel(receiver=receiver.name)
    power, std_db = (shown[name].values for name in ("power_dbm", "power_std_mean_db"))
    levels = record.observation[number][rows]
    heard = np.isfinite(levels)
    powers = drawing.shades(*np.nanpercentile(np.concatenate([levels[heard], power[np.isfinite(power)]]), [2, 98]))
    deviations = drawing.shades(0, float(np.nanmax(std_db)))

    figure = Figure(figsize=(10.5, 8), layout="constrained", facecolor="white")
    (plan_axes, predicted), (spread, phone) = panels = figure.subplots(2, 2, sharex=True, sharey=True)
    plan_axes.plot(*record.tx_pos_m[rows][~heard, :2].T, ".", color="0.7", markersize=2)
    drawing.draw_values(plan_axes, record.tx_pos_m[rows][heard], levels[heard], powers, s=12)
    plan_axes.set_title(
        f"Given: plan, and walks with readings of {len(record.receivers)} access points, one of them shown"
    )
    drawing.draw_layer(predicted, shown["x"].values, shown["y"].values, power, powers)
    predicted.set_title("Predicted power of this access point")
    drawing.draw_layer(spread, shown["x"].values, shown["y"].values, std_db, deviations)
    spread.set_title("Its standard deviation")
    _draw_phone(phone, place / "positions.csv")
    walls = scene_cuts(run, float(grid["height"]))
    for axes in panels.flat:
        drawing.draw_outlines(axes, walls, linewidths=0.3)
        axes.title.set_fontsize(9.5)
        x_m, y_m = grid["x"].values, grid["y"].values
        drawing.set_plan(axes, (x_m.min(), y_m.min()), (x_m.max(), y_m.max()))
        axes.label_outer()
    drawing.colour_bar(figure, powers, panels[0], "received power (dBm)", extend="both")
    drawing.colour_bar(figure, deviations, panels[1], "standard deviation (dB)")
    drawing.add_legend(figure)
    return figure


def _draw_phone(axes: Any, positions: Path) -> None:
    """The phone of median error: where it was, its estimate, and the circle of 90 % of the probability."""
    located = read_csv(positions)
    error_m = located.numbers("error_m")
    row = int(np.argsort(error_m)[len(error_m) // 2])
    x_m, y_m, true_x_m, true_y_m, radius_m = (
        float(located.numbers(name)[row]) for name in ("x", "y", "true_x", "true_y", "radius_m")
    )
    mark: dict[str, Any] = {"markeredgecolor": "white", "linestyle": "none", "markersize": 9}
    axes.add_patch(Circle((x_m, y_m), radius_m, alpha=0.25, color="C3", label="90 % of the probability"))
    axes.plot(x_m, y_m, "o", color="C3", label="estimate", **mark)
    axes.plot(true_x_m, true_y_m, "*", color="black", label="phone", **mark | {"markersize": 13})
    axes.set_title(f"A located phone, of median error: {error_m[row]:.1f} m")
