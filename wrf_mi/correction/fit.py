"""Parameters and choices of a stage, their prior, and least squares over the rows of one misfit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tracing.paths.material_parameters import EXPONENT, PREFIX
from ..tracing.paths.plane_parameters import SHIFT, TILT
from .choices import ABSENT, ABSENT_VALUES, Choice, material_places
from .frame import rigid_motions, scene_entries
from .least_squares import Noise, Prior, left_out_residuals, minimised, posterior_covariance
from .misfit import Misfit
from .options import FRAME, FRAME_SD, MATERIALS, PLANES, CorrectionOptions, OnStage
from .path_sum import PathSum, near

LEAST_PATHS = 10
"""Fewest paths of a surface or plane that is changed."""
STILL_ABSENT = 0.1
"""Susceptibility up to which a surface that was chosen to be absent is, after least squares."""
REFINING_STEPS = 3
"""Largest number of least-squares steps of one plane while shifts are compared."""
UNKNOWN = Noise(1.0, 1.0)
"""Noise before any least squares."""


@dataclass(frozen=True)
class State:
    """Parameters of a stage, and the choices that led to them.

    Attributes:
        stage: the stage, its parts joined by "+".
        vector: parameters [p].
        mean: means of the parameters' prior [p].
        materials: material of each surface that was chosen, by its name.
        noise: noise of the residuals after the last least squares.
    """

    stage: str
    vector: FloatArray
    mean: FloatArray
    materials: Mapping[str, str]
    noise: Noise = UNKNOWN

    def changed(self, choice: Choice, material: str, vector: FloatArray) -> State:
        """With the material of a choice, whose constants a vector [p] has; least squares stay near them."""
        mean = self.mean.copy()
        mean[choice.material] = vector[choice.material]
        return replace(self, vector=vector, mean=mean, materials={**self.materials, choice.what: material})


class Fit:
    """Least squares over the rows of one misfit.

    Args:
        misfit: residuals of the rows.
        options: options of the correction.
        on_stage: called as the fit goes on.
        supposed: names of objects that the stated scene lacks.
        bodies: names of the objects of each box.
    """

    def __init__(
        self,
        misfit: Misfit,
        options: CorrectionOptions,
        on_stage: OnStage,
        supposed: frozenset[str] = frozenset(),
        bodies: Sequence[frozenset[str]] = (),
    ) -> None:
        self.misfit, self.options, self.on_stage = misfit, options, on_stage
        objects = [name.partition("/")[0] for name in misfit.sides[0].slabs.names]
        of_bodies = [np.flatnonzero([thing in body for thing in objects]) for body in bodies]
        self.bodies = [slabs for slabs in of_bodies if len(slabs) > 1]
        names = misfit.sides[0].slabs.names
        self.supposed = {name: slab for slab, name in enumerate(names) if objects[slab] in supposed}
        self.stated = misfit.start.copy()
        self.frequency_hz = float(misfit.sides[0].scene.frequency[0])
        # Entries by their places in `Misfit.planes` and `Misfit.slabs`, those with most paths first.
        ranked = [(np.argsort(-count, kind="stable"), count) for count in misfit.counts()]
        self.planes, self.slabs = (order[count[order] >= LEAST_PATHS] for order, count in ranked)
        self.prior_deviation = np.ones(len(self.stated))
        for name, part in misfit.parts.items():
            self.prior_deviation[part] = options.deviation(name)
        for slab in self.supposed.values():
            self.stated[material_places(misfit, slab)] = ABSENT_VALUES
        self._match_gains()

    def _match_gains(self) -> None:
        """Stated gains match mean magnitudes over a receiver's carriers, as least squares of a phase need."""
        misfit, missing = self.misfit, dict[str, list[float]]()
        if not any(side.gain_name in misfit.parts for side in misfit.sides):
            return
        whole = misfit.residual(self.stated) + misfit.observed
        for side, model, places in zip(misfit.sides, misfit.models, misfit.places, strict=True):
            known = places[np.isfinite(misfit.observed[places]).all(axis=1)]
            if len(known):
                pair = (values[known].reshape(-1, *model.shape) for values in (whole, misfit.observed))
                missing.setdefault(side.gain_name, []).append(model.missing_gain(*pair))
        for name, gains in missing.items():
            self.stated[misfit.parts[name].start] += np.mean(gains)

    def start(self, stage: str) -> State:
        """The scene as stated, without the faces that it lacks."""
        return State(stage, self.stated, self.stated, dict.fromkeys(self.supposed, ABSENT))

    def free(self, kept: str) -> IntArray:
        """Entries of the vector that a stage changes: those of surfaces and planes that enough paths meet."""
        parts = kept.split("+")
        free = []
        for name, part in self.misfit.parts.items():
            entries = np.arange(part.start, part.stop)
            if name.startswith(PREFIX):
                known = MATERIALS in parts and (self.misfit.several_carriers or not name.endswith(EXPONENT))
                free.append(entries[self.slabs] if known else entries[:0])
            elif name in (SHIFT, TILT):
                size = len(entries) // len(self.misfit.planes)
                moved = entries.reshape(-1, size)[self.planes].ravel()
                free.append(moved if PLANES in parts or FRAME in parts else entries[:0])
            else:
                free.append(entries if kept else entries[:0])
        return np.sort(np.concatenate(free))

    def prior(self, mean: FloatArray, free: IntArray) -> Prior:
        """Prior of some entries about ``mean`` [p]; planes share the motions of the frame."""
        covariance = np.diag(np.square(self.prior_deviation[free]))
        if FRAME in self.options.parts and SHIFT in self.misfit.parts:
            _, among, which = np.intersect1d(free, self.misfit.plane_entries, return_indices=True)
            motions = self.misfit.motions[which]
            covariance[np.ix_(among, among)] += (motions * FRAME_SD**2) @ motions.T
        return Prior(mean[free], np.linalg.inv(covariance))

    def cost(self, state: State, noise: Noise) -> float:
        """Negative logarithm of likelihood and prior, without its constant."""
        free = self.free(state.stage)
        return noise.cost(self.misfit.residual(state.vector)) + self.prior(state.mean, free).cost(state.vector[free])

    def trial_costs(self, trials: Misfit | PathSum, noise: Noise, vectors: FloatArray) -> list[float]:
        """Negative logarithms of the likelihood of vectors [v, p] and of the planes' prior, without its constant."""
        free, prior = self._planes_prior
        costs = noise.costs(trials.mean_squares(vectors))
        return [float(cost) + prior.cost(vector[free]) for cost, vector in zip(costs, vectors, strict=True)]

    @cached_property
    def _planes_prior(self) -> tuple[IntArray, Prior]:
        free = np.intersect1d(self.misfit.plane_entries, self.free(PLANES))
        return free, self.prior(self.stated, free)

    def expected(self, vector: FloatArray, places: IntArray) -> FloatArray:
        """Entries by the rigid motion of the other planes that enough paths meet; those of materials as they are."""
        expected = vector[places].copy()
        if FRAME in self.options.parts and SHIFT in self.misfit.parts:
            by_frame = vector.copy()
            by_frame[self.misfit.plane_entries] = self.misfit.motions @ self._motion(vector, places)
            expected = by_frame[places]
        return expected

    def _motion(self, vector: FloatArray, without: IntArray) -> FloatArray:
        """Rigid motion [6] of the planes that enough paths meet, but for those of some entries."""
        planes, motions = self.misfit.plane_entries, self.misfit.motions
        known = np.isin(planes, np.setdiff1d(self.free(PLANES), without))
        weight = known / np.square(self.prior_deviation[planes])
        information = motions.T @ (weight[:, None] * motions) + np.diag(FRAME_SD**-2.0)
        return np.asarray(np.linalg.solve(information, motions.T @ (weight * vector[planes])), float)

    def absent(self, state: State) -> frozenset[int]:
        """Surfaces that a state leaves out of the scene, by their numbers there."""
        names = self.misfit.sides[0].slabs.names
        chosen = [slab for slab, name in enumerate(names) if state.materials.get(name) == ABSENT]
        thin = {slab for slab in chosen if state.vector[material_places(self.misfit, slab)[0]] < np.log(STILL_ABSENT)}
        absent = thin.union(set(self.supposed.values()).intersection(chosen))
        return frozenset(self.misfit.slabs[sorted(absent)].tolist())

    def of_scene(self, state: State) -> dict[str, FloatArray]:
        """Parameters by name for all planes and surfaces of the scene: planes that no path meets move with the frame,
        their materials are as stated.
        """
        misfit, parameters = self.misfit, self.misfit.of_scene(state.vector)
        if FRAME in state.stage.split("+"):
            surfaces = misfit.sides[0].surfaces
            count = len(surfaces.normal)
            moved = rigid_motions(surfaces) @ self._motion(state.vector, misfit.plane_entries[:0])
            moved[scene_entries(misfit.planes, count)] = state.vector[misfit.plane_entries]
            parameters |= {SHIFT: moved[:count], TILT: moved[count:].reshape(count, 2)}
        return parameters

    def carried_over(self, state: State, by: Fit) -> State:
        """A state of a fit to other paths, which meet other surfaces: vector and means of this fit's entries."""
        vector, mean = map(self.misfit.vector_of, (by.of_scene(state), by.misfit.of_scene(state.mean)))
        return replace(state, vector=vector, mean=mean)

    def refined(self, trials: Misfit | PathSum, start: FloatArray, places: IntArray) -> FloatArray:
        """Some least-squares steps of the entries of one choice; materials stay near those of ``start``."""
        places = places[np.isin(places, self.free("+".join(self.options.parts)))]
        mean, planes = start.copy(), self.misfit.plane_entries
        mean[planes] = self.stated[planes]
        jacobian = lambda vector: trials.jacobian(vector, places)  # noqa: E731
        return minimised(trials.residual, jacobian, start, places, self.prior(mean, places), REFINING_STEPS)[0]

    def solved(self, state: State, most_steps: int | None = None) -> State:
        """Least squares of a stage's entries from a state, in at most ``most_steps`` steps."""
        free, misfit = self.free(state.stage), self.misfit
        steps = self.options.steps if most_steps is None else min(most_steps, self.options.steps)

        def jacobian(vector: FloatArray) -> NDArray[np.float32]:
            return near(misfit, vector).jacobian(vector, free)

        def on_step(step: int) -> None:
            self.on_stage(f"least squares of {len(free)} parameters", step / steps)

        prior = self.prior(state.mean, free)
        vector, residual = minimised(misfit.residual, jacobian, state.vector, free, prior, steps, on_step)
        others = np.setdiff1d(misfit.plane_entries, free)
        if FRAME in state.stage.split("+"):  # too few paths meet them
            vector[others] = self.expected(vector, others)
        return replace(state, vector=vector, noise=Noise.of(residual))

    def uncertainty(self, state: State) -> tuple[FloatArray, FloatArray]:
        """Standard deviations of a state's free entries, and residuals [n_rx * rows, values] of each row by a fit to
        the others (`left_out_residuals`).
        """
        free, residual = self.free(state.stage), self.misfit.residual(state.vector)
        derivative = near(self.misfit, state.vector).jacobian(state.vector, free)
        covariance = posterior_covariance(derivative, residual, self.prior(state.mean, free), state.noise)
        return np.sqrt(np.diag(covariance)), left_out_residuals(derivative, residual, covariance, state.noise)
