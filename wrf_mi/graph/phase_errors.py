"""Expected spectra of paths whose phases are uncertain, on the device: see `wrf_mi.receivers.instruments`."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi

from ..backend.device import on_device
from ..backend.vectors import Complex, times
from ..receivers.instruments import DRAWS, phase_draws
from ..tracing.paths.traced_field import Float64, TracedPaths


@lru_cache(maxsize=64)
def draws_of(each: int) -> Any:
    """`wrf_mi.receivers.instruments.phase_draws` of ``each`` paths, flat."""
    return on_device(phase_draws(each).ravel(), Float64)


def with_phase_errors(paths: TracedPaths, bounces: Any, rows: Any | None, phase_error: float) -> TracedPaths:
    """`DRAWS` copies of each transmitter's paths, one after the other, with phases that are drawn.

    Args:
        paths: paths of the transmitters ``rows`` of a `wrf_mi.tracing.paths.traced_field.TracedField`.
        bounces: its square roots of numbers of reflections [n * each].
        rows: unsigned integers [batch]; None: all of its transmitters.
        phase_error: standard deviation of the phase that each reflection adds, rad, independently.

    Returns:
        Paths of ``batch * DRAWS`` transmitters.
    """
    each = paths.each
    lane = dr.arange(mi.UInt32, paths.batch * DRAWS * each)
    path, copy = lane % each, lane // each
    batch, draw = copy // DRAWS, copy % DRAWS
    row = batch if rows is None else dr.gather(mi.UInt32, rows, batch)
    # Errors of independent reflections add as squares.
    deviation = phase_error * dr.gather(Float64, bounces, row * each + path)
    sine, cosine = dr.sincos(deviation * dr.gather(Float64, draws_of(each), path * DRAWS + draw))
    source = batch * each + path
    re, im, length_m, *arrival = (
        dr.gather(Float64, part, source) for part in (*paths.gain, paths.length_m, *paths.arrival)
    )
    return TracedPaths(times((re, im), (cosine, sine)), length_m, arrival, paths.batch * DRAWS, each)


def for_draws(signal: Complex, batch: int, drawn: int) -> Complex:
    """The signals of ``batch`` transmitters as often as their paths are drawn, for ``drawn`` transmitters."""
    if drawn == batch:
        return signal
    each = dr.width(signal[0]) // batch
    lane = dr.arange(mi.UInt32, drawn * each)
    source = lane // (drawn // batch * each) * each + lane % each
    re, im = (dr.gather(type(part), part, source) for part in signal)
    return re, im


def mean_of_draws(report: Any, paths: TracedPaths | None, drawn: TracedPaths | None) -> Any:
    """Mean report of each transmitter of ``paths`` over its draws; a report without draws as it is."""
    if paths is None or drawn is None or drawn.batch == paths.batch:
        return report
    draws, each = drawn.batch // paths.batch, dr.width(report) // drawn.batch
    lane = dr.arange(mi.UInt32, dr.width(report))
    value, draw = lane // draws, lane % draws
    source = (value // each * draws + draw) * each + value % each
    return dr.block_reduce(dr.ReduceOp.Add, dr.gather(type(report), report, source), draws) / draws
