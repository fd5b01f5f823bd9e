"""Estimate of the time of a search for reflecting planes, before it begins."""

from __future__ import annotations

import logging

from ..core import InputError
from .options import TraceOptions
from .search import patterns

logger = logging.getLogger(__name__)

SECONDS_PER_HIT = 1.2e-7
"""Of each surface that a ray meets, on two cores; finding duplicates takes most of it (docs/limits.md)."""
WARN_S, MOST_S = 10.0, 3600.0
"""Durations from which a search is announced, and refused."""


def hits(options: TraceOptions, rays: int) -> int:
    """Number of surfaces that the rays of one source meet in a closed room; an upper bound elsewhere.

    Where waves pass surfaces, rays are shot once for each choice of the hits that reflect
    (`wrf_mi.tracing.search.shoot`), of which there are up to two to the power of the depth.
    """
    met = options.max_depth if options.transmission else options.reflections
    return len(patterns(met, options.reflections, options.transmission)) * rays * met if options.reflections else 0


def check_search(options: TraceOptions, rays: int, sources: int) -> None:
    """Announce a search that takes long, and refuse one that takes more than an hour.

    Args:
        options: kinds of path and depth.
        rays: number of rays from each source.
        sources: number of sources whose rays are shot.

    Raises:
        InputError: a search of more than an hour, naming what makes it shorter.
    """
    duration_s = sources * hits(options, rays) * SECONDS_PER_HIT
    if duration_s < WARN_S:
        return
    what = f"search for paths with up to {options.reflections} reflections"
    remedy = f"a smaller --depth (max_depth, {options.max_depth}) or --reflections (max_reflections)"
    if duration_s > MOST_S:
        raise InputError(f"{what}: about {duration_s / 3600:.1f} hours; give {remedy}")
    logger.warning("%s: about %.0f s; faster with %s", what, duration_s, remedy)
