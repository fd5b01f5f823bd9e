"""Choices that are made anew where what was found is in doubt.

Choices that were made while others were still wrong may hold these where they are: either fits only beside the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from ..core.angles import FloatArray
from .least_squares import Noise
from .path_sum import near
from .search import ABSENT, GAIN, Choice, alternatives

if TYPE_CHECKING:
    from .fit import Fit, Found

RECONSIDERED = 4
"""Largest number of times that doubtful surfaces are chosen anew."""
ELSEWHERE, MINIMA = 3, 2
"""Number of the least plausible planes or materials that are tried otherwise, and of other choices of each."""
APART = 1 / 8
"""Least distance of minima, wavelengths: paths change by up to a quarter."""


class Alternative(NamedTuple):
    """Vector [p] of an alternative of a choice, and the name of its material; None: as stated."""

    material: str | None
    vector: FloatArray


class Doubts:
    """Doubts about what a fit has found.

    Args:
        fit: the fit.
        choices: its choices.
        title: title of the progress.
    """

    def __init__(self, fit: Fit, choices: Sequence[Choice], title: str) -> None:
        self.fit, self.title = fit, title
        self.joint = [choice for choice in choices if choice.joint]
        self.material = [choice for choice in choices if choice.material.size]

    def settled(self, found: Found) -> Found:
        """The best that is found where doubtful surfaces are chosen anew, until each reason for doubt has failed, and
        then with one of the least plausible planes in another minimum.
        """
        if len(self.joint) < 2:
            return found
        doubts = [(self._implausible, self.joint), (self._unsupported, self.material)]
        failed, number = 0, 0
        while failed < len(doubts) and number < RECONSIDERED:
            doubt, those = doubts[number % len(doubts)]
            number += 1
            other = self._reconsidered(found, those, doubt, f"{self.title} in doubt, {number} of {RECONSIDERED}")
            noise = found.solution.noise
            better = self.fit.cost(other, noise) < self.fit.cost(found, noise) - GAIN
            found, failed = (other, 0) if better else (found, failed + 1)
        return self._with_planes_elsewhere(found)

    def _reconsidered(
        self,
        found: Found,
        choices: Sequence[Choice],
        doubt: Callable[[Sequence[Choice], FloatArray], FloatArray],
        what: str,
    ) -> Found:
        """The half of the surfaces that is doubted most, chosen anew beside the others."""
        most = np.sort(np.argsort(-doubt(choices, found.vector), kind="stable")[: (len(choices) + 1) // 2])
        doubted, start = [choices[number] for number in most], found.vector.copy()
        known = found.known
        for choice in doubted:
            start[choice.places] = self._absent(choice, start)
            known = known.with_material(choice, ABSENT, start)
        vector, known, _ = self.fit.chosen(known, start, doubted, what)
        return self.fit.solved(vector, known)

    def _with_planes_elsewhere(self, found: Found) -> Found:
        """The best that is found with one of the least plausible planes in another minimum."""
        wavelength_m = speed_of_light / self.fit.frequency_hz

        def same(choice: Choice, one: Alternative, other: Alternative) -> bool:
            place = choice.plane[0]
            return bool(abs(one.vector[place] - other.vector[place]) < APART * wavelength_m)

        doubt = self._implausible(self.joint, found.vector)
        return self._otherwise(found, self.joint, doubt, same, f"{self.title} in other minima")

    def with_other_materials(self, found: Found) -> Found:
        """The best that is found with another material of one of the surfaces that are farthest from the chosen one."""

        def same(choice: Choice, one: Alternative, other: Alternative) -> bool:
            return one.material == other.material

        if not self.material:
            return found
        places = np.array([choice.material for choice in self.material])
        away = (found.vector - found.known.mean) / self.fit.prior_deviation
        doubt = np.square(away[places]).sum(axis=-1)
        return self._otherwise(found, self.material, doubt, same, f"{self.title} of other materials", True)

    def _otherwise(
        self,
        found: Found,
        choices: Sequence[Choice],
        doubt: FloatArray,
        same: Callable[[Choice, Alternative, Alternative], bool],
        what: str,
        of_materials: bool = False,
    ) -> Found:
        """The best that is found with one of the choices doubted most made otherwise, all parameters adapted to it.

        What the others have adapted to the wrong choice makes the right one look worse until they may change.

        Args:
            found: what has been found.
            choices: choices.
            doubt: doubt of each.
            same: whether two alternatives of a choice are one.
            what: title of the progress.
            of_materials: see `wrf_mi.correction.search.alternatives`.
        """
        doubtful = np.argsort(-doubt, kind="stable")[:ELSEWHERE]
        for number, choice in enumerate([choices[place] for place in doubtful], 1):
            self.fit.on_stage(f"{what}, {number} of {len(doubtful)}", 0.0)
            noise, trials = found.solution.noise, near(self.fit.misfit, found.vector)
            tried = [Alternative(found.known.materials.get(choice.what), found.vector)]
            for _, name, there in alternatives(self.fit, trials, noise, choice, found.vector, of_materials):
                material = name.partition(",")[0]
                new = Alternative(material, there)
                if len(tried) > MINIMA or any(same(choice, one, new) for one in tried):
                    continue
                tried.append(new)
                other = self.fit.solved(there, found.known.with_material(choice, material, there))
                if self.fit.cost(other, noise) < self.fit.cost(found, noise) - GAIN:
                    found = other
                    break  # the other alternatives are beside what was found before
        return found

    def _implausible(self, choices: Sequence[Choice], vector: FloatArray) -> FloatArray:
        """Squared distances of planes from where the others let expect them, in standard deviations."""
        fit, places = self.fit, [choice.plane for choice in choices]
        away = [(vector[place] - fit.expected(vector, place)) / fit.prior_deviation[place] for place in places]
        return np.square(away).sum(axis=1)

    def _unsupported(self, choices: Sequence[Choice], vector: FloatArray) -> FloatArray:
        """Log-likelihoods without each surface, the higher the less observations tell of it."""
        trials, found = near(self.fit.misfit, vector), np.zeros(len(choices))
        noise = Noise.of(trials.residual(vector))
        for number, choice in enumerate(choices):
            there = vector.copy()
            there[choice.places] = self._absent(choice, vector)
            found[number] = -noise.cost(trials.residual(there))
        return found

    def _absent(self, choice: Choice, vector: FloatArray) -> FloatArray:
        """Values of a choice whose surface is left out; its plane is where the others let expect it."""
        values = next(values for name, values in choice.values.items() if name.startswith(ABSENT))
        return np.where(choice.of_plane, self.fit.expected(vector, choice.places), values)
