"""From published surveys to maps and positions, by five commands each."""

import re
from pathlib import Path

import numpy as np
import pytest
from changed_folders import DATA, needs
from commands import Command
from PIL import Image
from wrf_mi_bench.journey import COMMANDS as JOURNEY

WALKS = {
    "mall-f3": tuple(words.replace("mall-f3/", "{data}/").replace("runs/", "{out}/") for words in JOURNEY),
    "flat-ble": (
        "mesh {data}/layout.csv --wall-height 2.7 --out {out}/scene",
        "data import {data}/calibration_df.csv --test {data}/test_robot_df.csv --anchors {data}/anchors.csv --place 0.5"
        " --columns heading=- --out {out}/data",
        "train {out}/data --scene {out}/scene --preset fast --out {out}/run",
        "map {out}/run --step 0.25 --out {out}/map.nc",
        "locate {out}/run --out {out}/positions.csv",
    ),
    "wifi-office": (
        "data import {data}/database_office_train.csv --test {data}/database_office_test.csv --pitch 0.6"
        " --out {out}/data",
        "train {out}/data --preset fast --out {out}/run",
        "evaluate {out}/run",
        "map {out}/run --out {out}/map.nc",
        "locate {out}/run --out {out}/positions.csv",
    ),
}
"""A mall from its plan in GeoJSON, a flat from its walls, and an office without a plan. Rows within three metres and
half a metre are averaged, so that a walk takes minutes."""
LARGEST_M = {"mall-f3": 40.0, "flat-ble": 2.5, "wifi-office": 3.0}
"""Largest median error of positions that is plausible: a sixth of the mall's floor, a room."""
WORSE = 1.25
"""Largest ratio to the error of interpolation or nearest neighbours: a hybrid is hardly worse than what it contains."""


def figure(pattern: str, text: str) -> float:
    """The number that a line of the output states."""
    match = re.search(pattern, text, re.MULTILINE)
    assert match is not None, (pattern, text)
    return float(match[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(name, marks=needs(name)) for name in WALKS])
def test_a_survey_becomes_maps_and_positions_by_five_commands(name: str, tmp_path: Path, command: Command) -> None:
    lines = [line.format(data=DATA / name, out=tmp_path).split() for line in WALKS[name]]
    assert len(lines) == 5
    printed = {words[0]: command.done(words) for words in lines}
    scores = printed["train"]
    hybrid_db, idw_db = figure(r"^hybrid +([\d.]+)", scores), figure(r"^IDW of .*\(idw\) +([\d.]+)", scores)
    assert 1 < hybrid_db < min(8, WORSE * idw_db)
    assert "better than the best constant" in scores
    error_m = figure(r"^error \(m\) +([\d.]+)", printed["locate"])
    neighbours_m = figure(r"^error of \d+ nearest neighbours \(m\) +([\d.]+)", printed["locate"])
    assert 0.1 < error_m < min(LARGEST_M[name], WORSE * neighbours_m)
    outs = [words[words.index("--out") + 1] for words in lines if "--out" in words]
    pictures = [Path(out).with_suffix(".png") for out in outs if out.endswith((".nc", ".csv"))]
    for out in outs:
        pictures += [file for name in ("plan.png", "preview.png") if (file := Path(out) / name).exists()]
    assert len(pictures) == (3 if name == "wifi-office" else 4)
    for picture in pictures:
        with Image.open(picture) as image:
            assert np.asarray(image.convert("L")).std() > 5, picture
