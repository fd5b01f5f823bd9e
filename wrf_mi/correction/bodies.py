"""Faces of a box, which are most likely of one material, chosen together.

Waves that pass a cabinet lose what its front and its back do. As long as the back is missing, the front is taken to
lose both, and then neither fits without the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..core.angles import FloatArray
from .least_squares import Noise
from .misfit import Misfit
from .path_sum import PathSum, near
from .search import ABSENT, GAIN, Choice, alternatives, cost, material_choices

if TYPE_CHECKING:
    from .fit import Fit, Found

LIKELY = 3.0
"""Log-likelihood that counts for each face that becomes of the material of the others: most boxes are of one."""


class Bodies:
    """Choices of one material for all faces of a box.

    Args:
        fit: the fit.
        choices: its choices.
        title: title of the progress.
    """

    def __init__(self, fit: Fit, choices: Sequence[Choice], title: str) -> None:
        self.fit, self.title = fit, title
        self._shifts = {
            choice.what: replace(
                choice,
                places=choice.plane,
                values={name.partition(", ")[2]: values[choice.of_plane] for name, values in choice.values.items()},
                of_plane=np.ones(len(choice.plane), bool),
            )
            for choice in choices
            if choice.joint and choice.what in fit.supposed
        }

    def settled(self, found: Found) -> Found:
        """The best that is found with the faces of one box after another of one material."""
        fit = self.fit
        for number, slabs in enumerate(fit.bodies, 1):
            fit.on_stage(f"{self.title} of boxes", number / len(fit.bodies))
            faces = material_choices(fit.misfit, slabs, fit.frequency_hz)
            noise, trials = found.solution.noise, near(fit.misfit, found.vector)
            materials = [material for material in faces[0].values if material != ABSENT]
            each = [self._with_material(trials, noise, faces, material, found.vector) for material in materials]
            _, material, vector = min(each, key=lambda one: one[0])
            changed = [face for face in faces if found.known.materials.get(face.what) != material]
            if not changed:
                continue
            known = found.known
            for face in changed:
                known = known.with_material(face, material, vector)
            other = fit.solved(vector, known)
            if fit.cost(other, noise) < fit.cost(found, noise) + LIKELY * len(changed) - GAIN:
                found = other
        return found

    def _with_material(
        self, trials: Misfit | PathSum, noise: Noise, faces: Sequence[Choice], material: str, vector: FloatArray
    ) -> tuple[float, str, FloatArray]:
        """Cost of all faces of a material, supposed ones at their best shifts, the material, and the vector [p]."""
        there = vector.copy()
        for face in faces:
            there[face.places] = face.values[material]
        for face in faces:
            if face.what in self._shifts:
                there = alternatives(self.fit, trials, noise, self._shifts[face.what], there)[0][2]
        return cost(self.fit, trials, noise, there), material, there
