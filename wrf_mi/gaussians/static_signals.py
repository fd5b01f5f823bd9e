"""Signals of fields of static geometry, for a prediction by operator.

Those of `Factorised` and `WrfGs` are computed in NumPy, and parts that depend on the Gaussians alone once: the start of
a recorded Dr.Jit function takes longer than these small products.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_tensor
from ..backend.recorded import Recorded
from .fields import Factorised, WrfGs
from .network import dense, linear

ComplexArray = NDArray[np.complex64]
Coefficients = Callable[[NDArray[np.float32]], ComplexArray]
"""Coefficients c of transmitters [m, 3] in metres: [m, K], or signals [m, n]."""

PAIRS_PER_CHUNK = 1 << 15
"""Pairs of Gaussian and transmitter at once: 16 MB of a layer of 128."""


def static_signals(field: Any, params: Mapping[str, Any]) -> tuple[ComplexArray | None, Coefficients]:
    """Signals S = C c of a field: factors C [n, K], or None where the coefficients are the signals, and c.

    Other classes, subclasses included, may compute signals otherwise; theirs are `recorded_signals`.
    """
    if type(field) is Factorised:
        return _complex(params["signal"].reshape(2, field.terms, -1)).T, _functions(field, params)
    return None, (_wrf_gs_signals if type(field) is WrfGs else recorded_signals)(field, params)


def _complex(pair: Any) -> Any:
    return pair[0] + np.complex64(1j) * pair[1]


def _functions(field: Any, params: Mapping[str, Any]) -> Coefficients:
    def coefficients(tx_pos_m: Any) -> ComplexArray:
        return _complex(field.functions(params, tx_pos_m.T).reshape(2, field.terms, -1)).T

    return coefficients


def _wrf_gs_signals(field: Any, params: Mapping[str, Any]) -> Coefficients:
    products: Any = linear(params, "signal.0", field.features(params), "feature")
    count = products.shape[1]

    def coefficients(tx_pos_m: Any) -> ComplexArray:
        out, step = np.empty((len(tx_pos_m), count), np.complex64), max(1, PAIRS_PER_CHUNK // count)
        for first in range(0, len(tx_pos_m), step):
            encoded = field.encoding.transmitter(tx_pos_m[first : first + step].T)
            hidden = products[None]
            if len(encoded):
                hidden = hidden + (params["signal.0.transmitter"] @ encoded).T[:, :, None]
            pair: Any = linear(params, "signal.out", dense(params, "signal.1", np.maximum(hidden, 0)))
            out[first : first + step] = _complex(pair.swapaxes(0, 1))
        return out

    return coefficients


def recorded_signals(field: Any, params: Mapping[str, Any]) -> Coefficients:
    """Signals [m, n] of transmitters [m, 3] by the field's Dr.Jit function, recorded, one transmitter at a time."""
    tensors = {name: to_tensor(values) for name, values in params.items()}

    @Recorded
    def signals(params: Mapping[str, Any], tx_pos: Any) -> Any:
        with dr.suspend_grad():
            return field.gaussians(params, tx_pos).signal

    def coefficients(tx_pos_m: Any) -> ComplexArray:
        per_transmitter = (signals(tensors, to_tensor(position[:, None])) for position in tx_pos_m)
        return np.stack([_complex([part.numpy() for part in pair]) for pair in per_transmitter])

    return coefficients
