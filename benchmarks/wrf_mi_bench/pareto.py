"""Run time against error for every method on the traced room, which needs no data: table, JSON and picture."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from wrf_mi.runs.figures import save
from wrf_mi.runs.timing import one_blas_thread
from wrf_mi.synthetic.furnished_room import traced_room

from .methods import METHODS, Place
from .pareto_front import front, measure_methods, pareto_figure, table

ROWS = 400
"""Of training: as many as somebody measures in a day, and as the physics model's aim there is stated for."""
REFERENCE = "volprim_rf_basic, WRF-GS+, 270"
PICTURE = Path("docs/images/pareto.png")
"""Written where the command is called in a checkout of the project, and only there."""
FITS = Path("runs/bench/pareto/fits")
"""Fitted models below the working directory; a finished one with the same key is used again, which the log says."""


def main() -> dict[str, Any]:
    """Measure `METHODS`, some twenty minutes on two cores, and draw them."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    record, scene = traced_room()
    with one_blas_thread():
        points = measure_methods(Place(record, scene, FITS, ROWS), METHODS, REFERENCE)
    if PICTURE.parent.is_dir():
        save(pareto_figure(points, f"traced room, {ROWS} training rows, 90 x 360 directions"), PICTURE, dpi=130)
    return {"rows": table(points), "reference": REFERENCE, "front": front(points), "points": points}
