"""Options of a correction: what is changed, and what is known before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field

from ..core import InputError
from ..core.settings import NOT_NEGATIVE, CheckedSettings, Count, Positive, ShareBelow1
from ..tracing.options import MAX_DEGREE, MAX_DEPTH, SpecularOptions
from ..tracing.paths.instrument_parameters import TX_PATTERN
from ..tracing.paths.scene_parameters import EXPONENT, PREFIX, QUANTITIES, SHIFT, TILT
from ..tracing.paths.traced_field import TracedOptions

FRAME, HIDDEN, PHASES = "frame", "hidden", "phases"
MATERIALS, PLANES, GAIN, PATTERNS = "materials", "planes", "gain", "patterns"
GROUPS = (MATERIALS, PLANES, FRAME, HIDDEN, GAIN, "pose", PATTERNS, PHASES)  # parameter groups of a correction
DEVIATIONS = {
    "permittivity": 0.7,  # of the logarithm of permittivity - 1
    "conductivity": 1.4,  # of logarithms, too
    "thickness": 0.35,
    EXPONENT: 0.3,  # ITU-R P.2040 has 0.16 to 1.34 for building materials other than metal
    "gain": 10.0,  # of its logarithm, and of its phase in rad: no prior knowledge
    "position": 0.02,  # metres
    "turn": 0.02,  # rad
    "pattern": 0.1,
}
"""Standard deviations of parameters before the correction, by the last part of their names."""
TILT_SD_RAD = 0.005  # standard deviation of a plane's tilts
FRAME_SD = np.repeat([0.05, 0.02], 3)  # of the common displacement of planes against devices, metres, and rotation, rad
HELD = 0.01  # share of the deviations of planes that remains where they move with the frame alone

OnStage = Callable[[str, float], None]  # ``on_stage(what, share)``: what is done, and its share that is done, 0 to 1

Interactions = Annotated[int, Field(ge=1, le=MAX_DEPTH, description=f"1 to {MAX_DEPTH}")]
Degree = Annotated[int, Field(ge=0, le=MAX_DEGREE, description=f"0 to {MAX_DEGREE}")]


@dataclass(frozen=True)
class CorrectionOptions(SpecularOptions, CheckedSettings):
    """Options of a correction.

    Attributes:
        groups: parameter groups that may change, of `GROUPS`; with ``phases`` materials are fitted to channels whose
            paths have uncertain phases where no change of planes is kept (`wrf_mi.correction.uncertain_phases`).
        rows: most training rows that are compared, of images over all receivers; of more, a random subset, seeded by
            the split.
        faint: the weakest paths of a transmitter are dropped while their amplitudes add up to less than this share.
        steps: largest number of least-squares steps.
        pattern_degree: degree of the antennas' patterns, where they are changed.
        shift_sd_m: standard deviation of a plane's position before the correction, metres.
    """

    groups: tuple[str, ...] = (MATERIALS, PLANES, FRAME, HIDDEN)
    depth: Interactions = field(default=3, kw_only=True)
    rows: Count = 600
    faint: ShareBelow1 = 1e-3
    steps: Annotated[int, NOT_NEGATIVE] = 8
    pattern_degree: Degree = 2
    shift_sd_m: Positive = 0.02

    def __post_init__(self) -> None:
        """Check ranges and groups; `InputError` for a number out of range, no group or an unknown one."""
        super().__post_init__()
        if unknown := [group for group in self.groups if group not in GROUPS]:
            raise InputError(f"correct: {unknown[0]!r} is not a parameter group; choose of {', '.join(GROUPS)}")
        if HIDDEN in self.groups and MATERIALS not in self.groups:
            raise InputError(f"correct: {HIDDEN} needs {MATERIALS}, by which a face is there or not")
        needed = {"shift_sd_m": (PLANES, FRAME), "pattern_degree": (PATTERNS,)}
        for name, groups in needed.items():
            value = getattr(self, name)
            if value != getattr(CorrectionOptions, name) and not {*groups} & {*self.groups}:
                text = f"{name}={value:g}: of {' and '.join(groups)}, which {','.join(self.groups)} leaves"
                raise InputError(f"correct: {text}; omit it")
        if PHASES in self.groups and (MATERIALS not in self.groups or {PLANES, FRAME}.isdisjoint(self.groups)):
            raise InputError(f"correct: {PHASES} needs {MATERIALS}, and {PLANES} or {FRAME}, whose errors phases have")
        if not self.groups:
            raise InputError(f"correct: nothing to change; choose of {', '.join(GROUPS)}")

    @property
    def traced(self) -> TracedOptions:
        """Options of the traced component: reflections, transmissions, a material of each surface, planes that move."""
        degree = self.pattern_degree if PATTERNS in self.groups else 0
        return TracedOptions(
            self.options, degree, materials="surface", planes=True, faint=self.faint, constants=QUANTITIES
        )

    def changes(self, name: str) -> bool:
        """Whether a parameter of `wrf_mi.tracing.paths.traced_field.TracedField` is changed."""
        if name.startswith(PREFIX):
            return MATERIALS in self.groups
        if name in (SHIFT, TILT):
            return PLANES in self.groups or FRAME in self.groups
        last = name.rpartition(".")[2]
        kinds = {"gain": GAIN, "position": "pose", "turn": "pose", "pattern": PATTERNS}
        return (name == TX_PATTERN and PATTERNS in self.groups) or kinds.get(last) in self.groups

    def deviation(self, name: str) -> float:
        """Standard deviation of the entries of a parameter before the correction; of planes without the frame's."""
        of_planes = {SHIFT: self.shift_sd_m, TILT: TILT_SD_RAD}
        if name in of_planes:
            return of_planes[name] * (1 if PLANES in self.groups else HELD)
        return DEVIATIONS["pattern" if name == TX_PATTERN else name.rpartition(".")[2]]


DEFAULTS = CorrectionOptions()
STRENGTHS = CorrectionOptions((MATERIALS, GAIN), depth=6, reflections=2)
"""Defaults for signal strengths: waves pass several walls, and powers do not tell planes a few centimetres apart."""
