"""What evaluations leave out because the result does not need it: time without each omission, and the change by it.

Each call is timed as it is and with one omission switched off, interleaved in one process. The change is the largest
difference of any value of the result, relative to the largest value. Counts are those of one call.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from typing import Any
from unittest.mock import patch

import drjit as dr
import numpy as np

from wrf_mi.core.counts import counted
from wrf_mi.core.types import FloatArray, IntArray
from wrf_mi.gaussians import blend, footprint, tiles
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, transmitter_path
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.search import images, surfaces

from .comparison import Row, line
from .declared import lined
from .scaling import opened_room
from .side_by_side import powers
from .timing import Within, interleaved, ratio
from .workloads import field, splatting

REPEATS, MOST_S = 7, 15.0
TRANSMITTERS, TRIANGLES, GAUSSIANS = 64, 10_000, 3000
FAINT = 1e-3  # share of the amplitudes of all paths, the default of fits
FAR = 6.0  # Mahalanobis radius at which a footprint is 1e-8
OPTIONS = TraceOptions(transmission=False, depth=2, rays=1 << 14)
Omission = Callable[[], AbstractContextManager[Any]]


def every_pair(of: Any, chains: Any, targets_m: FloatArray) -> Iterator[tuple[IntArray, IntArray]]:
    """All pairs of chains and targets, as `wrf_mi.tracing.search.chains.possible` yields those worth a test."""
    for chain in np.array_split(np.arange(len(chains)), max(1, len(chains) * len(targets_m) >> 18)):
        yield np.repeat(chain, len(targets_m)), np.tile(np.arange(len(targets_m)), len(chain))


@contextmanager
def replaced(*values: tuple[Any, str, Any]) -> Iterator[None]:
    """Context with other values of modules."""
    with ExitStack() as stack:
        for module, name, value in values:
            stack.enter_context(patch.object(module, name, value))
        yield


def whole_plane(footprints: Any, height: int, width: int) -> tuple[Any, ...]:
    """Boxes of footprints that hold the whole image, in place of `wrf_mi.gaussians.tiles._boxes`."""
    kind, count = type(footprints.radius), dr.width(footprints.radius)
    return tuple(dr.full(kind, value, count) for value in (0.0, float(height), 0.0, float(width)))


def room_powers(scene: Any, again: bool = False) -> FloatArray:
    """Received powers of transmitters in a scene; ``again``: its planes are found anew."""
    if again:
        surfaces._FOUND.pop(scene, None)
    return powers(trace_paths(scene, transmitter_path(TRANSMITTERS), RECEIVER, OPTIONS).paths)


def field_of_paths(faint: float) -> Callable[[], FloatArray]:
    """Amplitudes of the traced field of transmitters of the laboratory, without its search."""
    options = TracedOptions(TraceOptions(depth=3), faint=faint)
    traced = TracedField(open_scene("laboratory", FREQUENCY_HZ), transmitter_path(TRANSMITTERS), RECEIVER, options)

    def call() -> FloatArray:
        gain = traced({}).gain
        summed = [np.asarray(part.numpy(), float).reshape(TRANSMITTERS, -1).sum(axis=1) for part in gain]
        return np.hypot(*summed)

    return call


def compared(what: str, call: Callable[[], Any], omission: Omission, without: Callable[[], Any] | None = None) -> Row:
    """Row of a call with and without an omission, which ``omission`` switches off; ``without``: another call for it."""
    with counted() as counts:
        as_it_is = np.asarray(call())
    other = Within(without or call, omission)
    with omission():
        all_of_it = np.asarray((without or call)())
    times = interleaved({"with": call, "without": other}, REPEATS, most_s=MOST_S)
    change = float(np.abs(as_it_is - all_of_it).max() / np.abs(all_of_it).max())
    share = [f"{of['evaluated']:,} of {sum(of.values()):,} {name}" for name, of in counts.items()]
    text = f"{ratio(times['without'], times['with'])} times as long without it, largest change {change:.1g}"
    return line(what, "; ".join([text, f"{np.median(times['with']):.3g} ms", *share]))


def main() -> dict[str, Any]:
    """All omissions; seconds on two cores."""
    room, splat = partial(room_powers, opened_room(TRIANGLES)), splatting(*field(GAUSSIANS))

    def image() -> FloatArray:
        return np.hypot(*(np.asarray(part.numpy(), float) for part in splat()))

    omissions: Mapping[str, tuple[Any, ...]] = {
        "chains and receivers whose reflections miss their planes": (
            room,
            partial(replaced, (images, "possible", every_pair)),
        ),
        "planes far from a point": (room, partial(replaced, (surfaces, "FEW_PLANES", 1 << 60))),
        "planes of a scene that were found before": (room, nullcontext, partial(room, again=True)),
        f"paths of {FAINT:g} of the amplitude, in fits": (field_of_paths(FAINT), nullcontext, field_of_paths(0.0)),
        "Gaussians that do not reach a tile of the image": (image, partial(replaced, (tiles, "_boxes", whole_plane))),
        "Gaussians beyond three standard deviations": (
            image,
            partial(replaced, (footprint, "CUTOFF", FAR), (blend, "CUTOFF", FAR)),
        ),
    }
    return {"rows": [compared(what, *how) for what, how in omissions.items()]}


table = lined("| left out | without the omission |", "| {what} | {value} |")
"""Rows of `compared`."""
