"""Calibration of materials with a von Mises phase error of each path, as published.

A channel h [n] is the sum over paths of g_p a_p exp(j phi_p) and complex noise of variance s^2 at n frequencies,
and the phases phi_p have a common von Mises prior of mean 0. Their posterior is approximated by independent von Mises
distributions, whose parameters follow in closed form, one path after another; the materials and the concentration of
the prior minimise the free energy, which is the negative logarithm of the likelihood for a single path.

Source: Ruah, Simeone, Hoydis and Al-Hashimi, "Calibrating wireless ray tracing for digital twinning using local phase
error estimates", arXiv 2312.12625, section IV; Mardia and Jupp, "Directional Statistics" (2000), section 3.5.4.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.special import i0e, i1e

from wrf_mi.core.types import FloatArray

Complex = NDArray[np.complex128]
SWEEPS = 30  # updates of all phases in an expectation step: paths of one delay resolution converge slowly
STEPS = 25  # expectation and maximisation steps
MOST_CONCENTRATED = 1e6  # concentration of the prior beyond which phases are certain


def resultant(concentration: FloatArray) -> FloatArray:
    """Mean resultant length I_1 / I_0 of a von Mises distribution."""
    return np.asarray(i1e(concentration) / i0e(concentration))


def log_i0(concentration: FloatArray) -> FloatArray:
    """Logarithm of the modified Bessel function I_0."""
    return np.asarray(np.log(i0e(concentration)) + concentration)


def phase_posterior(waves: Complex, channel: Complex, prior: float, noise: float) -> Complex:
    """Concentrations times exp(j mean) [p] of the phases of paths with waves [p, n] in a channel [n]."""
    posterior = np.zeros(len(waves), complex)
    moment = np.zeros(len(waves), complex)  # E exp(j phi)
    for _ in range(SWEEPS):
        for path, wave in enumerate(waves):
            others = channel - moment @ waves + moment[path] * wave
            posterior[path] = prior + 2 / noise * np.vdot(wave, others)
            moment[path] = resultant(np.abs(posterior[path])) * np.exp(1j * np.angle(posterior[path]))
    return posterior


def moments(posterior: Complex) -> Complex:
    """Mean resultants E exp(j phi) [p] of posteriors (`phase_posterior`)."""
    return np.asarray(resultant(np.abs(posterior)) * np.exp(1j * np.angle(posterior)))


def free_energy(waves: Complex, channel: Complex, posterior: Complex, prior: float, noise: float) -> float:
    """Upper bound of the negative log-likelihood of a channel [n]; equal to it for the best posterior of one path."""
    moment = moments(posterior)
    error = np.square(np.abs(channel - moment @ waves)).sum()
    error += ((1 - np.abs(moment) ** 2) * np.square(np.abs(waves)).sum(axis=1)).sum()
    # Divergence of the posterior from the prior, both von Mises.
    concentration = np.abs(posterior)
    divergence = log_i0(np.array(prior)) - log_i0(concentration) + concentration * np.abs(moment) - prior * moment.real
    return float(error / noise + len(channel) * np.log(np.pi * noise) + divergence.sum())


def prior_concentration(posteriors: list[Complex]) -> float:
    """Concentration of the prior for which posteriors of all channels are most probable."""
    mean = float(np.mean(np.concatenate([moments(each).real for each in posteriors])))
    if mean <= 0:
        return 0.0
    if mean >= resultant(np.array(MOST_CONCENTRATED)):
        return MOST_CONCENTRATED
    return float(brentq(lambda value: resultant(np.array(value)) - mean, 0, MOST_CONCENTRATED))


def calibrated(
    waves_of: Callable[[FloatArray], list[Complex]], channels: Complex, start: FloatArray, noise: FloatArray
) -> tuple[FloatArray, float]:
    """Parameters and the concentration of the prior, by expectation and maximisation.

    Args:
        waves_of: waves [p, n] of the paths of each channel for parameters.
        channels: measured channels [rows, n].
        start: parameters [k].
        noise: variance of the noise of each channel [rows].
    """
    parameters, prior, rows = np.array(start, float), 0.0, list(zip(channels, noise, strict=True))
    for _ in range(STEPS):
        posteriors = [
            phase_posterior(waves, channel, prior, variance)
            for waves, (channel, variance) in zip(waves_of(parameters), rows, strict=True)
        ]
        prior = prior_concentration(posteriors)

        def energy(
            trial: FloatArray, row_posteriors: list[Complex] = posteriors, concentration: float = prior
        ) -> float:
            of_rows = zip(waves_of(trial), rows, row_posteriors, strict=True)
            return sum(free_energy(w, h, post, concentration, s2) for w, (h, s2), post in of_rows)

        parameters = minimize(energy, parameters, method="Nelder-Mead", options={"maxiter": 40}).x
    return parameters, prior
