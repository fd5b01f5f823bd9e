"""Materials by channels whose paths have uncertain phases, as planes are off by an unknown share of the wavelength.

The channel of a row over n frequencies is the sum over paths of g a exp(j phi) and noise of variance s^2, with the gain
g, the waves a = exp(-j k L) and a phase error phi. Errors of planes, of standard deviations that are known before a
correction, lengthen a path by dL of variance v, so that phi = -k dL has the mean resultant length
rho = E exp(j phi) = exp(-k^2 v / 2), as a von Mises distribution has whose concentration kappa solves
I_1(kappa) / I_0(kappa) = rho. With errors of paths independent of each other, mean and covariance of the channel are

    mu = sum rho g a,    C = sum (1 - rho^2) |g|^2 a a^H + s^2 I,

and the sum of many paths is Gaussian. Where rho is 1 these are the coherent residuals, and where it is 0 the powers of
the delays that the band resolves. Rows have a complex t distribution of `FREEDOM` degrees of freedom with these moments
(`wrf_mi.correction.least_squares`), as some paths are absent in the scene.

Source: Ruah, Simeone, Hoydis and Al-Hashimi, "Calibrating wireless ray tracing for digital twinning using local phase
error estimates" (arXiv 2312.12625), who have a von Mises posterior of each path in place of the Gaussian; Mardia and
Jupp, "Directional Statistics" (2000), section 3.5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.sparse import csr_array

from ..core.types import FloatArray, IntArray
from ..tracing.paths.scene_parameters import PREFIX
from .least_squares import FREEDOM, Linearised, damped_steps
from .moves import SWEEPS, SurfaceChoice, material_choices
from .options import FRAME_SD
from .path_lengths import lengths_and_slopes
from .path_sum import STEP, PathSum, sums_of
from .state import State

if TYPE_CHECKING:
    from .misfit import Misfit
    from .state import ScenePosterior

MOST_FREQUENCIES = 16  # most frequencies of a row that are compared: derivatives of n x n covariances are kept
NOISE = np.geomspace(1e-3, 1, 10)  # variances of the noise that are tried, of the mean square of a median row
LEAST_GAIN = 3.0  # log-likelihood for which a material is chosen: ln 9 for the choice, and that of a standard deviation
TOGETHER = 1 << 22  # most products of waves that are held at once, of 16 bytes each
Complex = NDArray[np.complex128]


class Moments(NamedTuple):
    """Means [k, n] and covariances without noise [k, n, n] of the channels of k rows."""

    mean: Complex
    covariance: Complex


def moments(gain: Complex, resultant: FloatArray, wave: Complex, row: IntArray, count: int) -> Moments:
    """Mean and covariance of the channels of ``count`` rows for p paths of uncertain phases.

    Args:
        gain: gains of the paths [p].
        resultant: mean resultant length of each path's phase error [p], 0 to 1.
        wave: waves [p, n] for gains of one.
        row: row of each path [p].
        count: number of rows.
    """
    return _sums(resultant * gain, (1 - resultant**2) * np.abs(gain) ** 2, wave, row, count)


def _sums(signal: Complex, spread: FloatArray, wave: Complex, row: IntArray, count: int) -> Moments:
    n = wave.shape[1]
    mean, covariance = np.zeros((count, n), complex), np.zeros((count, n * n), complex)
    for part in np.array_split(np.arange(len(row)), 1 + len(row) * n * n // TOGETHER):
        adding = csr_array((np.ones(len(part)), (row[part], np.arange(len(part)))), (count, len(part)))
        outer = wave[part, :, None] * wave[part, None, :].conj()
        mean += adding @ (signal[part, None] * wave[part])
        covariance += adding @ (spread[part, None] * outer.reshape(len(part), -1))
    return Moments(mean, covariance.reshape(count, n, n))


class UncertainPhases:
    """Likelihood of the rows of a misfit of channels by its materials, planes being uncertain.

    ``noise`` is the variance of the noise relative to the mean square of a median row; None: the most probable for the
    stated scene.
    """

    def __init__(self, posterior: ScenePosterior, noise: float | None = None) -> None:
        misfit, paths = posterior.misfit, posterior.misfit.paths
        assert misfit.record.frequencies_hz is not None
        self.posterior, self.misfit, self._every = posterior, misfit, np.arange(len(paths.row))
        hz = np.asarray(misfit.record.frequencies_hz, float)
        chosen = np.unique(np.linspace(0, len(hz) - 1, min(len(hz), MOST_FREQUENCIES)).round().astype(int))
        wavenumber = 2 * np.pi * hz[chosen] / speed_of_light
        length_m, slope = lengths_and_slopes(misfit, np.where(paths.reflects, paths.plane, -1), misfit.start)
        self._wave = np.exp(-1j * length_m[:, None] * wavenumber)
        # Variance of the lengths by the prior of planes, and of the frame where that is uncertain, too.
        variance = slope.multiply(slope) @ posterior.prior_deviation[misfit.plane_entries] ** 2
        if posterior.has_frame:
            variance += np.square((slope @ posterior.motions) * FRAME_SD).sum(axis=1)
        self.resultant: FloatArray = np.exp(-(wavenumber.mean() ** 2) * variance / 2)
        stored = misfit.record.observation[:, misfit.rows].astype(complex)
        channel = stored.reshape(-1, stored.shape[-1])[:, chosen]
        # Rows without a path have no likelihood that materials change.
        self._rows, self._row = np.unique(paths.row, return_inverse=True)
        self._channel = channel[self._rows]
        self._known = np.isfinite(self._channel).all(axis=1)
        self._unit = float(np.median(np.square(np.abs(self._channel[self._known])).mean(axis=1)))
        stated_moments = self._moments_at(posterior.stated)
        self.noise = noise or float(min(NOISE, key=lambda each: self._cost(stated_moments, noise=each)))

    @staticmethod
    def serves(misfit: Misfit) -> bool:
        """Whether a misfit is of channels by materials and planes."""
        return sums_of(misfit) == "fields" and PathSum.serves(misfit)

    def scores(self, vector: FloatArray) -> FloatArray:
        """Log-likelihoods of all rows [n_rx * rows], without a constant; NaN without observation or path."""
        scores = np.full(len(self.misfit.observed), np.nan)
        costs = self._costs(self._moments_at(vector), self._channel, self.noise)
        scores[self._rows] = np.where(self._known, -costs, np.nan)
        return scores

    def best(self, stage: str) -> State:
        """The most probable materials of a stage: common ones, surface by surface, and then Fisher scoring."""
        state, choices = self.posterior.start(stage), material_choices(self.posterior, self.posterior.slabs)
        slabs = self.posterior.slabs.tolist()
        for sweep in range(SWEEPS):
            before = state
            for number, (slab, choice) in enumerate(zip(slabs, choices, strict=True)):
                self.posterior.on_stage("uncertain phases: choices", (sweep + number / len(choices)) / SWEEPS)
                state = self._chosen(state, slab, choice)
            if state is before:
                break
        return self.refined(state)

    def _chosen(self, state: State, slab: int, choice: SurfaceChoice) -> State:
        """The state with the most probable material of one surface, if it is more probable than the present one."""
        paths = np.flatnonzero((self.misfit.paths.slab == slab).any(axis=1))
        rows, row = np.unique(self._row[paths], return_inverse=True)
        # All paths of these rows without those that meet the surface, which each alternative adds again.
        others = np.setdiff1d(np.flatnonzero(np.isin(self._row, rows)), paths)
        gain = self.misfit.gains(state.vector, others)
        fixed = moments(
            gain, self.resultant[others], self._wave[others], np.searchsorted(rows, self._row[others]), len(rows)
        )

        def cost(vector: FloatArray) -> float:
            changed = moments(
                self.misfit.gains(vector, paths), self.resultant[paths], self._wave[paths], row, len(rows)
            )
            return self._cost(Moments(*(a + b for a, b in zip(fixed, changed, strict=True))), rows)

        vectors = {}
        for name, values in choice.values.items():
            vectors[name] = state.vector.copy()
            vectors[name][choice.places] = values
        costs = {name: cost(vector) for name, vector in vectors.items()}
        best = min(costs, key=costs.__getitem__)
        if cost(state.vector) - costs[best] < LEAST_GAIN:
            return state
        return state.chosen(choice.what, best, choice.places, vectors[best])

    def refined(self, state: State) -> State:
        """Fisher scoring of the materials, damped as least squares are."""
        free, steps = self.free(state), self.posterior.options.steps

        def linearised(vector: FloatArray, _: Moments) -> Linearised[Moments]:
            return self._cost, *self._normal(vector, free)

        def on_step(step: int) -> None:
            self.posterior.on_stage(f"uncertain phases: {len(free)} parameters", step / steps)

        prior = self.posterior.prior(state.mean, free)
        vector, _ = damped_steps(self._moments_at, linearised, state.vector, free, prior, steps, on_step)
        return replace(state, vector=vector)

    def free(self, state: State) -> IntArray:
        """Entries of materials that the state's stage changes."""
        materials = [np.arange(span.start, span.stop) for name, span in self._materials.items()]
        return np.intersect1d(state.free, np.concatenate(materials))

    @property
    def _materials(self) -> Mapping[str, slice]:
        return {name: span for name, span in self.misfit.slices.items() if name.startswith(PREFIX)}

    def deviation(self, state: State) -> FloatArray:
        """Standard deviations [p], 0 of entries other than `free`."""
        free, deviation = self.free(state), np.zeros(len(state.vector))
        information = self._normal(state.vector, free)[0] + self.posterior.prior(state.mean, free).precision
        deviation[free] = np.sqrt(np.diag(np.linalg.inv(information)))
        return deviation

    def _moments_at(self, vector: FloatArray) -> Moments:
        gain = self.misfit.gains(vector, self._every)
        return moments(gain, self.resultant, self._wave, self._row, len(self._rows))

    def _cost(self, of_rows: Moments, rows: IntArray | None = None, noise: float | None = None) -> float:
        which = slice(None) if rows is None else rows
        costs = self._costs(of_rows, self._channel[which], self.noise if noise is None else noise)
        return float(costs[self._known[which]].sum())

    def _costs(self, of_rows: Moments, channel: Complex, noise: float) -> FloatArray:
        """Negative log-likelihoods [k] of channels [k, n], without a constant."""
        root, white = self._whitened(of_rows, channel, noise)
        size = np.square(np.abs(white)).sum(axis=1)
        logarithm = 2 * np.log(np.einsum("knn->kn", root).real).sum(axis=1)
        return np.asarray(logarithm + (FREEDOM / 2 + white.shape[1]) * np.log1p(2 * size / FREEDOM))

    def _whitened(self, of_rows: Moments, channel: Complex, noise: float) -> tuple[Complex, Complex]:
        """Cholesky factors [k, n, n] of the covariances with noise, and residuals [k, n] that they make white."""
        noisy = of_rows.covariance + noise * self._unit * np.eye(channel.shape[1])
        root = np.asarray(np.linalg.cholesky(noisy), complex)
        return root, np.asarray(np.linalg.solve(root, (channel - of_rows.mean)[:, :, None])[:, :, 0], complex)

    def _normal(self, vector: FloatArray, free: IntArray) -> tuple[FloatArray, FloatArray]:
        """Fisher information [k, k] and gradient [k] of the cost by the entries ``free``.

        Source: of a complex Gaussian, Kay, "Fundamentals of Statistical Signal Processing" (1993), section 15.7.
        """
        gain, count = self.misfit.gains(vector, self._every), self._channel.shape[1]
        present = moments(gain, self.resultant, self._wave, self._row, len(self._rows))
        root, white = self._whitened(present, np.where(self._known[:, None], self._channel, present.mean), self.noise)
        size = np.square(np.abs(white)).sum(axis=1)
        weight = np.where(self._known, (FREEDOM + 2 * count) / (FREEDOM + 2 * size), 0)
        inverse = np.linalg.inv(root)
        columns = np.zeros((len(free), len(self._rows), 2 * count * (count + 1)), np.float32)
        slope = np.zeros(len(free))
        for place, (paths, change) in enumerate(self._gain_changes(vector, gain, free)):
            rows, row = np.unique(self._row[paths], return_inverse=True)
            finite = self._known[rows]
            resultant = self.resultant[paths]
            spread = (1 - resultant**2) * 2 * (gain[paths].conj() * change).real
            changed = _sums(resultant * change, spread, self._wave[paths], row, len(rows))
            mean = (inverse[rows] @ changed.mean[:, :, None])[:, :, 0]
            covariance = inverse[rows] @ changed.covariance @ inverse[rows].conj().swapaxes(1, 2)
            trace = np.einsum("knn->k", covariance).real
            along = np.einsum("kn,knm,km->k", white[rows].conj(), covariance, white[rows]).real
            along += 2 * (white[rows].conj() * mean).sum(axis=1).real
            slope[place] = (finite * trace - weight[rows] * along).sum()
            parts = np.concatenate([np.sqrt(2) * mean, covariance.reshape(len(rows), -1)], axis=1)
            columns[place, rows] = finite[:, None] * parts.view(float)
        flat = columns.reshape(len(free), -1)
        return (flat @ flat.T).astype(float), slope

    def _gain_changes(self, vector: FloatArray, gain: Complex, free: IntArray) -> list[tuple[IntArray, Complex]]:
        """Paths that each entry ``free`` changes, and derivatives of their gains."""
        changes = dict[int, tuple[IntArray, Complex]]()
        for span in self._materials.values():
            constants = np.arange(span.start, span.stop)
            # Surfaces that no path meets together change at once.
            for group in self.misfit.apart:
                together = group[np.isin(constants[group], free)]
                if not len(together):
                    continue
                beside = vector.copy()
                beside[constants[together]] += STEP
                met = np.flatnonzero(np.isin(self.misfit.paths.slab, together).any(axis=1))
                changed = self.misfit.gains(beside, met) - gain[met]
                for slab in together.tolist():
                    column = int(constants[slab])
                    paths = np.flatnonzero((self.misfit.paths.slab == slab).any(axis=1))
                    step = float(np.float32(beside[column])) - float(np.float32(vector[column]))
                    changes[column] = paths, changed[np.searchsorted(met, paths)] / step
        return [changes[int(column)] for column in free]
