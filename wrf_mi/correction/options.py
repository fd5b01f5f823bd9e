"""Options of a correction: what is changed, and what is known before."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from ..core import InputError
from ..core.settings import NOT_NEGATIVE, CheckedSettings, Positive, ShareBelow1
from ..tracing.instrument_parameters import TX_PATTERN
from ..tracing.material_parameters import EXPONENT, PREFIX
from ..tracing.options import MAX_DEGREE, MAX_DEPTH, MAX_RAYS
from ..tracing.plane_parameters import SHIFT, TILT

FRAME, HIDDEN = "frame", "hidden"
MATERIALS, PLANES, GAIN, PATTERNS = "materials", "planes", "gain", "patterns"
PARTS = (MATERIALS, PLANES, FRAME, HIDDEN, GAIN, "pose", PATTERNS)
"""What a correction may change."""
EXPONENT_SD = 0.3
"""Standard deviation of the exponent of a conductivity with the frequency; ITU-R P.2040 has 0.16 to 1.34 for building
materials other than metal."""
FLAT = 10.0
"""Standard deviation of the logarithm of a gain, and of its phase in rad: no prior knowledge."""

OnStage = Callable[[str, float], None]
"""``on_stage(what, share)``: what is done, and the share of it that is done, 0 to 1."""


@dataclass(frozen=True)
class CorrectionOptions(CheckedSettings):
    """Options of a correction.

    Attributes:
        parts: parts that may change, of `PARTS`.
        depth: largest number of interactions of a path, transmissions included.
        reflections: largest number of reflections among them.
        rows: most training rows that are compared; of more, a random subset, seeded by the split.
        rays: number of rays that search from each receiver.
        faint: the weakest paths of a transmitter are dropped while their amplitudes add up to less than this share.
        steps: largest number of least-squares steps.
        pattern_degree: degree of the antennas' patterns, where they are changed.
        shift_sd_m: standard deviation of a plane's position before the correction, metres.
        tilt_sd_rad: standard deviation of a plane's tilts, rad.
        frame_sd_m: standard deviation of the common displacement of all planes against the devices, metres.
        frame_sd_rad: standard deviation of their common rotation, rad.
        material_sd: standard deviation of the logarithm of a material's permittivity - 1; its conductivity has twice,
            its thickness half of it.
        pose_sd_m: standard deviation of a receiver's position, metres.
        pose_sd_rad: standard deviation of a receiver's orientation, rad.
        pattern_sd: standard deviation of a pattern's coefficient.
    """

    parts: tuple[str, ...] = (MATERIALS, PLANES, FRAME, HIDDEN)
    depth: Annotated[int, Field(ge=1, le=MAX_DEPTH, description=f"1 to {MAX_DEPTH}")] = 3
    reflections: Annotated[int, NOT_NEGATIVE] = 3
    rows: Annotated[int, Field(ge=1, description="1 or more")] = 600
    rays: Annotated[int, Field(ge=1, le=MAX_RAYS, description=f"1 to {MAX_RAYS}")] = 1 << 16
    faint: ShareBelow1 = 1e-3
    steps: Annotated[int, NOT_NEGATIVE] = 8
    pattern_degree: Annotated[int, Field(ge=0, le=MAX_DEGREE, description=f"0 to {MAX_DEGREE}")] = 2
    shift_sd_m: Positive = 0.02
    tilt_sd_rad: Positive = 0.005
    frame_sd_m: Positive = 0.05
    frame_sd_rad: Positive = 0.02
    material_sd: Positive = 0.7
    pose_sd_m: Positive = 0.02
    pose_sd_rad: Positive = 0.02
    pattern_sd: Positive = 0.1

    def __post_init__(self) -> None:
        """Check ranges and parts.

        Raises:
            InputError: a number out of range, no part or an unknown one.
        """
        super().__post_init__()
        if unknown := [part for part in self.parts if part not in PARTS]:
            raise InputError(f"correct: {unknown[0]!r} is not a part; choose of {', '.join(PARTS)}")
        if HIDDEN in self.parts and MATERIALS not in self.parts:
            raise InputError(f"correct: {HIDDEN} needs {MATERIALS}, by which a face is there or not")
        if not self.parts:
            raise InputError(f"correct: nothing to change; choose of {', '.join(PARTS)}")

    def changes(self, name: str) -> bool:
        """Whether a parameter of `wrf_mi.tracing.traced_field.TracedField` is changed."""
        if name.startswith(PREFIX):
            return MATERIALS in self.parts
        if name in (SHIFT, TILT):
            return PLANES in self.parts or FRAME in self.parts
        last = name.rpartition(".")[2]
        kinds = {"gain": GAIN, "position": "pose", "turn": "pose", "pattern": PATTERNS}
        return (name == TX_PATTERN and PATTERNS in self.parts) or kinds.get(last) in self.parts

    def deviation(self, name: str) -> float:
        """Standard deviation of the entries of a parameter before the correction; of planes without the frame's."""
        scale = {"permittivity": 1.0, "conductivity": 2.0, "thickness": 0.5}
        last = name.rpartition(".")[2]
        if last == EXPONENT:
            return EXPONENT_SD
        if name.startswith(PREFIX):
            return self.material_sd * scale[last]
        tight = PLANES not in self.parts
        found = {
            SHIFT: self.shift_sd_m * (0.01 if tight else 1),
            TILT: self.tilt_sd_rad * (0.01 if tight else 1),
            "gain": FLAT,
            "position": self.pose_sd_m,
            "turn": self.pose_sd_rad,
        }
        return found.get(name, found.get(last, self.pattern_sd))


DEFAULTS = CorrectionOptions()
STRENGTHS = CorrectionOptions((MATERIALS, GAIN), depth=6, reflections=2)
"""Defaults for signal strengths: waves pass several walls, and powers do not tell planes a few centimetres apart."""
