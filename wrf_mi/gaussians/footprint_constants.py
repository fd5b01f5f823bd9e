"""Constants of a footprint, common to every evaluation of a field and to the oracle."""

import math

LOW_PASS_RAD = math.radians(0.3)
"""Standard deviation added in quadrature to each footprint: 0.3 pixel at one degree per pixel."""

CUTOFF = 3.0
"""Mahalanobis radius beyond which a footprint is zero; the jump there is exp(-4.5) = 0.011."""

NEAR_M = 0.05
"""A Gaussian whose centre is closer to the receiver than this has no footprint."""

MIN_COSINE = 0.1
"""Cosine of the largest angle, about 84 degrees, between a Gaussian's direction and a pixel it reaches.

The central projection onto the tangent plane diverges at 90 degrees and would mirror what lies behind.
"""

LOG2_E = math.log2(math.e)
"""Footprints are powers of two, which processors compute faster than exp."""
