"""Settings of a graph, plain values that a configuration file states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from ..core.settings import Positive, ShareBelow1
from ..tracing.options import DISC, MAX_DEGREE, SpecularOptions

EvaluationName = Literal["splatted", "traced"]  # evaluations of Gaussians (`wrf_mi.graph.evaluations`)
SPLATTED: EvaluationName = "splatted"
TRACED: EvaluationName = "traced"
TRACED_NAMES = ("material.", "plane.", "receiver.", "pattern.", "surface.")
"""Prefixes of the traced component's parameters (`wrf_mi.tracing.paths.traced_field.TracedField.parameters`)."""


@dataclass(frozen=True)
class TracedConfig(SpecularOptions):
    """Paths of a scene that are trained together with the Gaussians: options of tracing, and learning rates.

    A parameter of rate 0 stays at its stated value and costs nothing.

    Attributes:
        faint: the weakest paths of a transmitter are dropped while their amplitudes add up to less than this share of
            those of all paths, with the scene's stated materials; 0: none.
        pattern_degree: degree of trainable factors of the antennas' patterns; 0: none.
        materials: ``named``: each named material has a permittivity and a conductivity; ``surface``: each surface has
            its own, the faces of one object in one plane, initialised from the named material.
        alone: share of the steps in which only the paths are trained, before the Gaussians.
        material: rate of permittivities and conductivities (of their logarithms).
        gain: rate of each receiver's gain (of its logarithm, and of its phase in rad).
        pattern: rate of the patterns' coefficients.
        position: rate of the receivers' positions, metres.
        turn: rate of the receivers' orientations, rad.
        shift: rate of the planes' shifts along their normals, metres.
        tilt: rate of the planes' tilts, rad.
        surface: rate of the factors of Gaussians on the surfaces (of their logarithms, and of their phases in rad); 0:
            no such Gaussians.
        surface_spacing: distance of neighbouring Gaussians on a surface, metres.
    """

    faint: ShareBelow1 = 1e-3
    pattern_degree: Annotated[int, Field(ge=0, le=MAX_DEGREE, description=f"0 to {MAX_DEGREE}")] = 0
    materials: Literal["named", "surface"] = "named"
    alone: ShareBelow1 = 0.25
    material: float = 0.05
    gain: float = 0.05
    pattern: float = 0.01
    position: float = 0.0
    turn: float = 0.0
    shift: float = 0.0
    tilt: float = 0.0
    surface: float = 0.02
    surface_spacing: Positive = 0.5

    def rate(self, name: str) -> float:
        """Learning rate of a parameter of `wrf_mi.tracing.paths.traced_field.TracedField.parameters`."""
        if name == DISC:
            return 0.0
        first, last = name.partition(".")[0], name.rpartition(".")[2]
        rate: float = getattr(self, first if first in ("material", "pattern", "surface") else last)
        return rate

    @property
    def moves_planes(self) -> bool:
        """Whether training moves the scene's planes."""
        return self.shift > 0 or self.tilt > 0


DEFAULT = TracedConfig()
