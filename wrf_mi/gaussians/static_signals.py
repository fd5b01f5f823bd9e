"""Signals of fields of static geometry in NumPy, for a prediction by operator.

Parts that depend on the Gaussians alone are computed once. The arithmetic is that of the fields; the start of a
recorded Dr.Jit function takes longer than these small products.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .factorised import Factorised
from .fields import WrfGs

Array = NDArray[np.float32]
ComplexArray = NDArray[np.complex64]

PAIRS_PER_CHUNK = 1 << 15
"""Pairs of Gaussian and transmitter at once: 16 MB of a layer of 128."""


class Signals(Protocol):
    """Signals S = C c(tx) of a field.

    Attributes:
        factors: C, [n, K]; None: c are the signals.
    """

    factors: ComplexArray | None

    def coefficients(self, tx_pos_m: ArrayLike) -> ComplexArray:
        """Coefficients c of transmitters [m, 3] in metres: [m, K], or [m, n] without factors."""
        ...


def encode(points: ArrayLike, octaves: int, scale_m: float) -> Array:
    """`wrf_mi.gaussians.encoding.encode` of points [3, n]: [6 * octaves, n]."""
    t = np.asarray(points, np.float32)
    if octaves == 0:
        return np.zeros((0, t.shape[1]), np.float32)
    octave = [t * np.float32(2.0**k / (2.0 * scale_m)) for k in range(octaves)]
    turns = np.concatenate([o - np.rint(o) for o in octave]) * np.float32(2 * np.pi)
    return np.concatenate([np.sin(turns), np.cos(turns)])


def _layer(params: Mapping[str, Array], name: str, x: Any, part: str = "hidden") -> Any:
    return params[f"{name}.{part}"] @ x + params[f"{name}.bias"]


def _relu(x: Any) -> Any:
    return np.maximum(x, 0, out=x)


class FactorisedSignals:
    """Signals of a `Factorised` field with its parameters: c are its functions phi."""

    def __init__(self, field: Factorised, params: Mapping[str, Array]) -> None:
        self._field, self._params = field, params
        re, im = params["signal"].reshape(2, field.terms, -1)
        self.factors: ComplexArray | None = (re + 1j * im).T.astype(np.complex64)

    def coefficients(self, tx_pos_m: ArrayLike) -> ComplexArray:
        """Coefficients of `Signals`."""
        field, e = self._field, self._field.encoding
        encoded = encode(np.asarray(tx_pos_m, np.float32).T, e.tx_octaves, e.tx_scale_m)
        hidden = _relu(_layer(self._params, "terms.0", encoded, "transmitter"))
        for i in range(1, field.layers):
            hidden = _relu(_layer(self._params, f"terms.{i}", hidden))
        re, im = _layer(self._params, "terms.out", hidden).reshape(2, field.terms, -1)
        return (re + np.complex64(1j) * im).T


class WrfGsSignals:
    """Signals of a `WrfGs` field with its parameters; the products of the Gaussians' features are computed once."""

    factors: ComplexArray | None = None

    def __init__(self, field: WrfGs, params: Mapping[str, Array]) -> None:
        e = field.encoding
        encoded = encode(params["position"], e.position_octaves, e.position_scale_m)
        hidden = _relu(_layer(params, "attenuation.0", encoded, "position"))
        for i in range(1, field.layers):
            hidden = _relu(_layer(params, f"attenuation.{i}", hidden))
        self._encoding, self._params = e, params
        self._products = _layer(params, "signal.0", hidden, "feature")

    def coefficients(self, tx_pos_m: ArrayLike) -> ComplexArray:
        """Coefficients of `Signals`."""
        tx = np.asarray(tx_pos_m, np.float32)
        count = self._products.shape[1]
        out = np.empty((len(tx), count), np.complex64)
        step = max(1, PAIRS_PER_CHUNK // count)
        for first in range(0, len(tx), step):
            part = slice(first, first + step)
            encoded = encode(tx[part].T, self._encoding.tx_octaves, self._encoding.tx_scale_m)
            seen = self._products[None]
            if len(encoded):
                seen = seen + (self._params["signal.0.transmitter"] @ encoded).T[:, :, None]
            hidden = _relu(_layer(self._params, "signal.1", np.maximum(seen, 0)))
            pair = _layer(self._params, "signal.out", hidden)
            out[part] = pair[:, 0] + np.complex64(1j) * pair[:, 1]
        return out


def host_signals(field: Any, params: Mapping[str, Array]) -> Signals | None:
    """The signals of a field in NumPy; None for other classes, subclasses included, which may compute them
    otherwise.
    """
    if type(field) is Factorised:
        return FactorisedSignals(field, params)
    if type(field) is WrfGs:
        return WrfGsSignals(field, params)
    return None
