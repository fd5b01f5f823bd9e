"""Time of a prediction by operator compared with direct evaluation.

`tests/gaussians/test_operator.py` compares their results.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from wrf_mi.gaussians import Factorised, WrfGs, WrfGsPlus
from wrf_mi.graph.graph import Graph
from wrf_mi.receivers.registry import PIXEL, ObservationSpec
from wrf_mi.synthetic.laboratory import RECEIVER
from wrf_mi.tasks.scores import bootstrap
from wrf_mi.training.predictor import Predictor

from .comparison import line
from .declared import lined
from .timing import interleaved
from .workloads import HEIGHT, WIDTH, parameters

GAUSSIANS, BATCH = 10_000, 64
SIZE_DEG = 3.0  # angular standard deviation of each Gaussian: 115 weights a pixel
SMALL = 270  # Gaussians of the default fit
ALL, REPEATS = f"operator, {BATCH}", 15
SPECTRUM = "ms of one spectrum, "  # beginning of the names of rows


def main() -> dict[str, Any]:
    """Times of a spectrum in ms: by network and splatting both, and by operator, alone and for `BATCH` transmitters."""
    tx = np.random.default_rng(0).uniform(-2, 2, (BATCH, 3)).astype(np.float32)
    cases: dict[str, tuple[Any, int, float]] = {
        "WRF-GS, 270 Gaussians": (WrfGs(), SMALL, 7.0),
        "WRF-GS, 10,000 Gaussians": (WrfGs(), GAUSSIANS, SIZE_DEG),
        "WRF-GS+, 270 Gaussians": (WrfGsPlus(), SMALL, 7.0),
        "factorised, 270 Gaussians": (Factorised(), SMALL, 7.0),
    }
    rows = []
    for name, (field, count, size) in cases.items():
        graph = Graph(field, [RECEIVER], ObservationSpec(PIXEL, (HEIGHT, WIDTH)))
        predictor = partial(Predictor, graph, parameters(field, count, size))
        calls = {"both": partial(predictor(), tx[:1])}
        if field.static_geometry:
            by_operator = predictor(operator=True)
            calls |= {"operator": partial(by_operator, tx[:1]), ALL: partial(by_operator, tx)}
        times = interleaved(calls, REPEATS, most_s=30)
        texts = (f"{key} {bootstrap(ms / (BATCH if key == ALL else 1))}" for key, ms in times.items())
        rows.append(line(f"{SPECTRUM}{name}", "; ".join(texts)))
    return {"rows": rows}


def _ms(row: Mapping[str, str]) -> dict[str, str] | None:
    """Milliseconds of each part without their intervals; None for other rows."""
    if not row["what"].startswith(SPECTRUM):
        return None
    parts = (part.partition(" (")[0].rpartition(" ") for part in row["value"].split("; "))
    empty = dict.fromkeys(("operator", ALL), "")
    return {"title": row["what"].removeprefix(SPECTRUM), **empty, **{name: ms for name, _, ms in parts}}


table = lined(
    f"| ms of a spectrum | splatted | operator | operator, {BATCH} at once |",
    f"| {{title}} | {{both}} | {{operator}} | {{{ALL}}} |",
    _ms,
)
"""Milliseconds of a spectrum by splatting and by operator."""
