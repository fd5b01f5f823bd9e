"""Kriging of channels: the line of sight with a diffuse field, or generic.

Multipath turns a channel's phase within a wavelength, so nothing but the line of sight is known further from
measurements than that; within, the covariance of a diffuse field is sharper than a fitted exponential one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.spatial import KDTree

from ...core import Prediction
from ...core.angles import FloatArray
from .by_receiver import Probabilistic, ReceiverRows, Single, observed_rows
from .kriging import GenericKriging, UncertainKriged, asks_generic, kriged
from .path_loss import NEAREST_M

Complex = NDArray[np.complexfloating[Any, Any]]
NEIGHBOURS = 32  # nearest rows that predict: farther ones are screened by them, and a solve costs their cube
SHARES = (0.3, 0.6, 0.9, 0.99, 0.999)
"""Candidate shares of the field in the residual power, the rest being noise; held-out rows choose."""
CERTAIN = 3.0  # standard errors by which predictions with the field must be better than without
LEAST_ROWS = 8
"""Least number of rows that may choose the line of sight: its gain, fitted to all of them, flatters them by 2 / n."""
NEGLIGIBLE = 1e-8  # share of the mean power, -80 dB, below which an error no longer counts in the choice


@dataclass(frozen=True)
class DiffuseField:
    """Complex Gaussian field with covariance sin(k d) / (k d): waves from all directions with equal power.

    Source: Cook et al., "Measurement of correlation coefficients in reverberant sound fields" (1955), J. Acoust. Soc.
    Am. 27; the same holds for scalar waves of any kind.

    Attributes:
        position_m, value: residual channels [n, subcarriers] at positions [n, 3].
        k: mean wave number, rad/m.
        power, share: mean of abs(value)^2, and the field's share of it; the rest is noise of each row.
    """

    position_m: FloatArray
    value: Complex
    k: float
    power: float
    share: float

    def predict(self, position_m: FloatArray, skip: int = 0) -> tuple[Complex, FloatArray]:
        """Mean [m, subcarriers] and variance [m] of residuals, noise included, at positions [m, 3] in metres.

        The ``skip`` nearest rows are not used: 1 leaves out the row at the position itself.
        """
        count = len(position_m)
        if self.share == 0 or len(self.position_m) <= skip:
            return np.zeros((count, self.value.shape[1]), complex), np.full(count, self.power)
        # A few neighbours screen all others; the factor of all rows would cost their cube.
        near = min(NEIGHBOURS, len(self.position_m) - skip)
        distance, index = KDTree(self.position_m).query(position_m, k=list(range(1 + skip, near + skip + 1)))
        between = np.linalg.norm(self.position_m[index][:, :, None] - self.position_m[index][:, None], axis=-1)
        matrix = self.share * np.sinc(self.k * between / np.pi) + (1 - self.share) * np.eye(near)
        across = self.share * np.sinc(self.k * distance / np.pi)
        weight = np.linalg.solve(matrix, across[..., None])[..., 0]
        mean = np.einsum("mn,mnf->mf", weight, self.value[index])
        return mean, self.power * np.maximum(1 - (weight * across).sum(axis=-1), 1e-6)


def fit_diffuse(position_m: FloatArray, value: Complex, k: float) -> DiffuseField:
    """The field whose share predicts each row best from the others (logarithmic score).

    ``value`` [n, subcarriers] holds residual channels at positions [n, 3] in metres, ``k`` the mean wave number, rad/m.
    """
    power = float(np.square(np.abs(value)).mean()) if len(value) else 0.0
    best = DiffuseField(position_m, value, k, power, 0.0)
    if power == 0 or len(value) <= 2:
        return best
    lowest = _scores(best)
    for share in SHARES:
        field = replace(best, share=share)
        scores = _scores(field)
        gain = lowest - scores
        # A spurious field adds its neighbours' errors to correct predictions: only a certain gain is accepted.
        if gain.mean() > CERTAIN * gain.std() / np.sqrt(len(gain)):
            lowest, best = scores, field
    return best


def _scores(field: DiffuseField) -> FloatArray:
    """Score of each row predicted from the others [n]; robust to rows that lack a path."""
    mean, variance = field.predict(field.position_m, skip=1)
    error = np.square(np.abs(field.value - mean)).mean(axis=1)
    # Of a Student-t-like density, whose tail a few rows without their line of sight do not dominate.
    return np.asarray(np.log(variance) + 2 * np.log1p(error / variance))


def direct_wave(tx_pos_m: FloatArray, receiver_m: FloatArray, k: FloatArray) -> Complex:
    """Free-space channels [n, subcarriers] of unit gain at wave numbers k, rad/m; positions in metres."""
    phase = k * np.maximum(np.linalg.norm(tx_pos_m - receiver_m, axis=1), NEAREST_M)[:, None]
    return np.asarray(np.exp(-1j * phase) / (2 * phase))  # Friis: wavelength / (4 pi d) = 1 / (2 k d)


@dataclass(frozen=True)
class KrigedChannels(Probabilistic):
    """Channels of one receiver: line of sight times a gain, and a diffuse field."""

    receiver_m: FloatArray  # position of the receiver [3], metres
    k: FloatArray  # wave number of each subcarrier, rad/m
    gain: complex  # complex gain of the line of sight
    field: DiffuseField
    like: Complex  # empty array of the type of observations

    @classmethod
    def fit(cls, position_m: FloatArray, observed: Complex, receiver_m: FloatArray, k: FloatArray) -> KrigedChannels:
        """Gain by least squares, and the field of its residuals, from channels [n, subcarriers]."""
        direct = direct_wave(position_m, receiver_m, k)
        # One complex gain for all subcarriers: antennas and cables are taken to be flat over the band.
        gain = complex(np.vdot(direct, observed) / np.vdot(direct, direct))
        field = fit_diffuse(position_m, observed - gain * direct, float(k.mean()))
        return cls(receiver_m, k, gain, field, np.empty(0, observed.dtype))

    def left_out(self) -> Complex:
        """Errors of the training rows, each predicted from all others, [n, subcarriers]."""
        return np.asarray(self.field.value - self.field.predict(self.field.position_m, skip=1)[0])

    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> Complex:
        """Channels [m, subcarriers] at positions [m, 3], metres; antennas are isotropic."""
        return self.prediction(tx_pos).mean

    def prediction(self, tx_pos: FloatArray) -> Prediction:
        """Channels and standard deviations at positions [m, 3], metres."""
        residual, variance = self.field.predict(tx_pos)
        mean = (self.gain * direct_wave(tx_pos, self.receiver_m, self.k) + residual).astype(self.like.dtype)
        return Prediction(mean, np.broadcast_to(np.sqrt(variance)[:, None], mean.shape))

    def facts(self) -> dict[str, Any]:
        """Gain of the line of sight, power of the rest and the field's share of it."""
        power_db = float(10 * np.log10(max(self.field.power, 1e-300)))
        gain_db = float(20 * np.log10(max(abs(self.gain), 1e-300)))
        gain = {"gain_db": gain_db, "gain_phase_rad": float(np.angle(self.gain))}
        diffuse = {"diffuse_share": self.field.share, "rest_power_db": power_db}
        return {"parts": "line of sight, diffuse field"} | gain | diffuse


class ChannelKriging(GenericKriging):
    """Kriging of channels: line of sight and diffuse field where they are clearly better, else generic."""

    headings = False  # antennas are isotropic

    def fit_single(self, rows: ReceiverRows) -> Single:
        """Kriging of the channels of one receiver.

        Raises:
            InputError: no row that was received, or channels that are all zero.
        """
        record = rows.problem.record
        if asks_generic(rows.problem) or record.frequencies_hz is None or rows.observation.ndim != 2:
            return kriged(rows)
        position_m, observed, _ = observed_rows(rows.tx_pos_m, rows.observation)
        generic = UncertainKriged.of(kriged(rows), observed)
        if len(observed) < LEAST_ROWS:
            return generic
        k = np.broadcast_to(2 * np.pi * np.asarray(record.frequencies_hz, float) / speed_of_light, observed.shape[1])
        channels = KrigedChannels.fit(position_m, observed, rows.receiver.position_m, k)
        left = [np.square(np.abs(errors)).mean(axis=1) for errors in (generic.left_out(), channels.left_out())]
        # Of logarithms, as accuracy is scored in decibels, and so that no strong row near the receiver decides alone. A
        # share of the power is added, below which an error no longer counts.
        generic_log, channels_log = np.log(np.array(left) + NEGLIGIBLE * np.square(np.abs(observed)).mean())
        gain = generic_log - channels_log
        # Few rows prefer one of both by chance, and generic kriging, which assumes least, is then the safer one.
        return channels if gain.mean() > CERTAIN * gain.std() / np.sqrt(len(gain)) else generic
