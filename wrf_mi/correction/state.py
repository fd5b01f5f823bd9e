"""State of a correction: parameters and choices of a stage, and their posterior over the rows of one misfit.

The scan's frame is off against that of the devices by a rigid motion, x -> x + w x (x - c) + t with c the mean of the
planes' centres. To first order in w, a plane n . x = d with the centre p and the axes a, b is shifted by
n . (t + w x (p - c)) and tilted by a . (w x n), b . (w x n): so the planes' prior is a Gaussian with a common part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..core.types import FloatArray, IntArray
from ..tracing.paths.scene_parameters import (
    EXPONENT,
    LEAST_CONDUCTIVITY,
    LEAST_SUSCEPTIBILITY,
    PREFIX,
    QUANTITIES,
    SHIFT,
    SURFACE,
    TILT,
    name_of,
)
from ..tracing.search.surfaces import Surfaces
from .least_squares import Jacobian, Noise, Prior, left_out_residuals, minimised, posterior_covariance
from .misfit import Misfit
from .options import FRAME, FRAME_SD, MATERIALS, PLANES, CorrectionOptions, OnStage
from .path_sum import PathSum, near

LEAST_PATHS = 10  # fewest paths of a surface or plane that is changed
ABSENT = "absent"  # choice of a surface that waves do not notice
ABSENT_VALUES = np.append(np.log([LEAST_SUSCEPTIBILITY, LEAST_CONDUCTIVITY, 0.001]), 0.0)
"""Its entries of the vector, in the order of `QUANTITIES`; 1 mm of almost nothing."""
STILL_ABSENT = 0.1  # susceptibility up to which a surface that was chosen to be absent is, after least squares
REFINING_STEPS = 3  # largest number of least-squares steps of one plane while shifts are compared
UNKNOWN = Noise(1.0, 1.0)  # noise before any least squares


@dataclass(frozen=True)
class SceneEdit:
    """A state of a correction by itself, without the rows that led to it: for all planes and surfaces of the scene.

    Parameters and the means of their prior are by the names of `wrf_mi.tracing.paths.traced_field.TracedField`.
    """

    stage: str  # parameter groups that were changed, joined by "+"
    parameters: Mapping[str, FloatArray]
    mean: Mapping[str, FloatArray]
    materials: Mapping[str, str]  # material of each surface that was chosen, by its name
    absent: IntArray  # surfaces that are left out of the scene, by their numbers there, ascending
    planes: IntArray  # planes and surfaces of which something is known, by their numbers in the scene
    slabs: IntArray
    noise: Noise = UNKNOWN  # noise of the residuals after the last least squares

    def at(self, posterior: ScenePosterior) -> State:
        """The state over some rows and paths, which may meet other surfaces: vector and means of their entries."""
        vector, mean = (posterior.vector_of(values) for values in (self.parameters, self.mean))
        return State(posterior, self.stage, vector, mean, self.materials, self.noise)


@dataclass(frozen=True)
class State:
    """Parameters of a stage, and the choices that led to them."""

    posterior: ScenePosterior  # what rows of measurements and prior knowledge tell of them
    stage: str  # the stage, its parameter groups joined by "+"; "" for the stated scene
    vector: FloatArray  # parameters [p]
    mean: FloatArray  # means of the parameters' prior [p]
    materials: Mapping[str, str]  # material of each surface that was chosen, by its name
    noise: Noise = UNKNOWN  # noise of the residuals after the last least squares

    @property
    def free(self) -> IntArray:
        """Entries of the vector that the stage changes."""
        return self.posterior.free(self.stage)

    @property
    def _moves_frame(self) -> bool:
        return FRAME in self.stage.split("+")

    def chosen(self, surface: str, material: str, places: IntArray, vector: FloatArray) -> State:
        """With another material of a surface, whose entries ``places`` a vector [p] has; least squares stay near."""
        mean = self.mean.copy()
        mean[places] = vector[places]
        return replace(self, vector=vector, mean=mean, materials={**self.materials, surface: material})

    def cost(self, noise: Noise) -> float:
        """Negative logarithm of likelihood and prior, without its constant."""
        # Residuals of the tracer itself, as a sum over paths is linear in planes and moves get far.
        free, posterior = self.free, self.posterior
        likelihood = noise.cost(posterior.misfit.residual(self.vector))
        return likelihood + posterior.prior(self.mean, free).cost(self.vector[free])

    def solved(self, most_steps: int | None = None) -> State:
        """Least squares of the stage's entries, in at most ``most_steps`` steps."""
        posterior, free = self.posterior, self.free
        misfit, steps = posterior.misfit, posterior.options.steps
        steps = steps if most_steps is None else min(most_steps, steps)

        # Derivatives by a sum over paths near each vector, residuals exact: steps end where the exact cost is least.
        def jacobian(vector: FloatArray) -> Jacobian:
            return near(misfit, vector).jacobian(vector, free)

        def on_step(step: int) -> None:
            posterior.on_stage(f"least squares of {len(free)} parameters", step / steps)

        prior = posterior.prior(self.mean, free)
        vector, residual = minimised(misfit.residual, jacobian, self.vector, free, prior, steps, on_step)
        if self._moves_frame:  # planes that too few paths meet follow those that many meet
            others = np.setdiff1d(misfit.plane_entries, free)
            vector[others] = posterior.expected(vector, others)
        return replace(self, vector=vector, noise=Noise.of(residual))

    def scene_parameters(self) -> dict[str, FloatArray]:
        """Parameters by name for all planes and surfaces of the scene.

        Planes that no path meets move with the frame; their materials are as stated.
        """
        misfit, parameters = self.posterior.misfit, self.posterior.misfit.of_scene(self.vector)
        if self._moves_frame:
            surfaces = misfit.traced_fields[0].surfaces
            count = len(surfaces.normal)
            # All planes move with the frame, and those that have entries as their entries say.
            moved = rigid_motions(surfaces) @ self.posterior.motion(self.vector, misfit.plane_entries[:0])
            moved[scene_entries(misfit.planes, count)] = self.vector[misfit.plane_entries]
            parameters |= {SHIFT: moved[:count], TILT: moved[count:].reshape(count, 2)}
        return parameters

    @property
    def edit(self) -> SceneEdit:
        """The state by itself, for other rows or paths."""
        misfit, absent = self.posterior.misfit, np.array(sorted(self.absent()), np.int64)
        of_scene = self.scene_parameters(), misfit.of_scene(self.mean), self.materials
        return SceneEdit(self.stage, *of_scene, absent, misfit.planes, misfit.slabs, self.noise)

    def at(self, posterior: ScenePosterior) -> State:
        """The state over other rows or paths."""
        return self.edit.at(posterior)

    def absent(self) -> frozenset[int]:
        """Surfaces that are left out of the scene, by their numbers there."""
        misfit = self.posterior.misfit
        names = misfit.traced_fields[0].slabs.names
        slabs = [slab for slab, name in enumerate(names) if self.materials.get(name) == ABSENT]
        # Least squares may bring a surface back that the choice left out; a face that the scan lacks, it may not.
        thin = {slab for slab in slabs if self.vector[material_places(misfit, slab)[0]] < np.log(STILL_ABSENT)}
        supposed = set(self.posterior.supposed.values()).intersection(slabs)
        return frozenset(misfit.slabs[sorted(thin | supposed)].tolist())

    def uncertainty(self) -> tuple[FloatArray, FloatArray]:
        """Standard deviations of the free entries, and `left_out_residuals` [n_rx * rows, values]."""
        free, misfit = self.free, self.posterior.misfit
        residual = misfit.residual(self.vector)
        derivative = near(misfit, self.vector).jacobian(self.vector, free)
        prior = self.posterior.prior(self.mean, free)
        covariance = posterior_covariance(derivative, residual, prior, self.noise)
        # Rounding makes variances that the data leave nothing of negative.
        deviation = np.sqrt(np.maximum(np.diag(covariance), 0))
        return deviation, left_out_residuals(derivative, residual, covariance, self.noise)


def _met_most(count: IntArray) -> IntArray:
    order = np.argsort(-count, kind="stable")
    return order[count[order] >= LEAST_PATHS]


class ScenePosterior:
    """Likelihood of the rows of one misfit, and the prior of its parameters.

    ``hidden`` are names of objects that the stated scene lacks, ``bodies`` names of the objects of each box;
    ``on_stage`` is called as a search goes on.
    """

    def __init__(
        self,
        misfit: Misfit,
        options: CorrectionOptions,
        on_stage: OnStage,
        hidden: frozenset[str] = frozenset(),
        bodies: Sequence[frozenset[str]] = (),
    ) -> None:
        self.misfit, self.options, self.on_stage = misfit, options, on_stage
        names = misfit.traced_fields[0].slabs.names  # <object>/<plane>
        objects = np.array([name.partition("/")[0] for name in names], str)
        faces = [np.flatnonzero(np.isin(objects, [*body])) for body in bodies]
        self.bodies = [slabs for slabs in faces if len(slabs) > 1]  # places in `Misfit.slabs` of the faces of each box
        # Surfaces of objects that the stated scene lacks: their places in `Misfit.slabs` by name.
        self.supposed = {names[slab]: slab for slab in np.flatnonzero(np.isin(objects, [*hidden])).tolist()}
        self.frequency_hz = float(misfit.traced_fields[0].scene.frequency[0])
        # Places among the misfit's planes and slabs, most paths first. Few paths tell of no surface: their noise would
        # move it anywhere within the prior.
        self.planes, self.slabs = map(_met_most, misfit.counts())
        self.prior_deviation = np.ones(len(misfit.start))
        for name, span in misfit.slices.items():
            self.prior_deviation[span] = options.deviation(name)
        # The start: faces that the scan lacks are absent, gains are those of the observations.
        self.stated = misfit.start.copy()
        for slab in self.supposed.values():
            self.stated[material_places(misfit, slab)] = ABSENT_VALUES
        for name, gain in misfit.missing_gains(self.stated).items():
            self.stated[misfit.slices[name].start] += gain

    def vector_of(self, parameters: Mapping[str, FloatArray]) -> FloatArray:
        """The vector [p] of parameters of the whole scene; those of receivers without any are as at the start."""
        # Of receivers that the rows before lacked nothing is known.
        return self.misfit.vector_of({**self.misfit.of_scene(self.stated), **parameters})

    def start(self, stage: str) -> State:
        """The scene as stated, without the faces that it lacks."""
        return State(self, stage, self.stated, self.stated, dict.fromkeys(self.supposed, ABSENT))

    def free(self, stage: str) -> IntArray:
        """Entries of the vector that a stage changes: those of surfaces and planes that enough paths meet."""
        groups, free = stage.split("+"), list[IntArray]()
        for name, span in self.misfit.slices.items():
            entries = np.arange(span.start, span.stop)
            if name.startswith(PREFIX):
                # One carrier tells nothing of how a conductivity depends on the frequency.
                is_free = MATERIALS in groups and (self.misfit.several_carriers or not name.endswith(EXPONENT))
                entries = entries[self.slabs]
            elif name in (SHIFT, TILT):
                is_free = not {PLANES, FRAME}.isdisjoint(groups)
                entries = entries.reshape(len(self.misfit.planes), -1)[self.planes].ravel()
            else:
                is_free = bool(stage)
            if is_free:
                free.append(entries)
        return np.sort(np.concatenate([np.zeros(0, np.int64), *free]))

    @property
    def has_frame(self) -> bool:
        """Whether planes share a motion of the frame."""
        return FRAME in self.options.groups and SHIFT in self.misfit.slices

    def prior(self, mean: FloatArray, free: IntArray) -> Prior:
        """Prior of some entries about ``mean`` [p]; planes share the motions of the frame."""
        covariance = np.diag(np.square(self.prior_deviation[free]))
        if self.has_frame:
            # Shifts and tilts are the frame's motion M w plus each plane's deviation: covariance D + M S M^T.
            _, among, which = np.intersect1d(free, self.misfit.plane_entries, return_indices=True)
            motions = self.motions[which]
            covariance[np.ix_(among, among)] += (motions * FRAME_SD**2) @ motions.T
        return Prior(mean[free], np.linalg.inv(covariance))

    def trial_costs(self, trials: Misfit | PathSum, noise: Noise, vectors: FloatArray) -> list[float]:
        """Negative logarithms of the likelihood of vectors [v, p] and of the planes' prior, without its constant."""
        # Materials have no prior here: alternatives are other means of it.
        free, prior = self._planes_prior
        costs = noise.costs(trials.mean_squares(vectors))
        return [float(cost) + prior.cost(vector[free]) for cost, vector in zip(costs, vectors, strict=True)]

    @cached_property
    def _planes_prior(self) -> tuple[IntArray, Prior]:
        free = np.intersect1d(self.misfit.plane_entries, self.free(PLANES))
        return free, self.prior(self.stated, free)

    @cached_property
    def motions(self) -> FloatArray:
        """Derivatives of the misfit's plane entries by a rigid motion of the scene [3 k, 6] (`rigid_motions`)."""
        every = rigid_motions(self.misfit.traced_fields[0].surfaces)
        return every[scene_entries(self.misfit.planes, len(every) // 3)]

    def expected(self, vector: FloatArray, places: IntArray) -> FloatArray:
        """Entries by the rigid motion of the other planes that enough paths meet; those of materials as they are."""
        if not self.has_frame:
            return vector[places].copy()
        # Without the entries themselves, which are to be judged.
        by_frame = vector.copy()
        by_frame[self.misfit.plane_entries] = self.motions @ self.motion(vector, places)
        return by_frame[places]

    def motion(self, vector: FloatArray, without: IntArray) -> FloatArray:
        """Rigid motion [6] of the planes that enough paths meet, but for those of some entries."""
        # The mean of its Gaussian posterior, planes being measurements of it with the errors of their prior.
        planes, motions = self.misfit.plane_entries, self.motions
        measured = np.isin(planes, np.setdiff1d(self.free(PLANES), without))
        weight = measured / np.square(self.prior_deviation[planes])
        information = motions.T @ (weight[:, None] * motions) + np.diag(FRAME_SD**-2.0)
        return np.asarray(np.linalg.solve(information, motions.T @ (weight * vector[planes])), float)

    def refined(self, trials: Misfit | PathSum, noise: Noise, places: IntArray, start: FloatArray) -> FloatArray:
        """Some least-squares steps of the entries of one choice; materials stay near those of ``start``."""
        places = places[np.isin(places, self.free("+".join(self.options.groups)))]
        # Materials have their prior about the alternative, planes about the stated scene.
        mean, planes = start.copy(), self.misfit.plane_entries
        mean[planes] = self.stated[planes]
        # With the noise by which alternatives are compared, rows that the choice does not change need no evaluation.
        residual, jacobian = trials.within(start, places)
        prior = self.prior(mean, places)
        return minimised(residual, jacobian, start, places, prior, REFINING_STEPS, noise=noise)[0]


def material_places(misfit: Misfit, slab: int) -> IntArray:
    """Entries of the vector that the material of a slab has, in the order of `QUANTITIES`."""
    return np.array([misfit.slices[name_of(SURFACE, quantity)].start + slab for quantity in QUANTITIES])


def rigid_motions(surfaces: Surfaces) -> FloatArray:
    """Derivatives of the planes' shifts [q], then tilts [q, 2] row by row, by a rigid motion of the scene: [3 q, 6].

    The translation t in metres has the first three columns, the rotation vector w in rad the last.
    """
    centre = surfaces.plane_centres_m
    middle = centre.mean(axis=0) if len(centre) else np.zeros(3)
    normal, axes = surfaces.normal, surfaces.axes
    # n . (w x r) = w . (r x n), a . (w x n) = w . (n x a)
    shift = np.concatenate([normal, np.cross(centre - middle, normal)], axis=1)
    turn = np.cross(normal[:, None], axes)
    tilt = np.concatenate([np.zeros_like(turn), turn], axis=2).reshape(-1, 6)
    return np.concatenate([shift, tilt])


def scene_entries(planes: IntArray, count: int) -> IntArray:
    """Rows of `rigid_motions` of some of ``count`` planes, by their numbers [k]: shifts, then tilts, [3 k]."""
    return np.concatenate([planes, count + (2 * planes[:, None] + np.arange(2)).ravel()])


def rigid_motion(surfaces: Surfaces, change: FloatArray, precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The rigid motion that is nearest to shifts and tilts of planes, and its standard deviations, [6] each.

    ``change`` [3 q] are shifts of the q planes in metres, then tilts in rad row by row, and ``precision`` the inverse
    variances of each. Motions that no plane fixes, such as along a corridor, are 0 with an infinite standard deviation.
    """
    motions = rigid_motions(surfaces)
    information = motions.T @ (precision[:, None] * motions)
    # A pseudo-inverse: motions along a corridor have no information, and get none.
    inverse = np.linalg.pinv(information, rcond=1e-9, hermitian=True)
    fixed = np.diag(information) > 0
    return inverse @ motions.T @ (precision * change), np.where(fixed, np.sqrt(np.diag(inverse)), np.inf)
