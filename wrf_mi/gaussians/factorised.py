"""A field of static Gaussians whose signals are mixtures of a few functions of the transmitter.

    S_i(tx) = sum_k C_ik phi_k(tx),   k = 1..K

phi is a small network of the encoded transmitter, C_ik are complex parameters of the Gaussians. The received field is
therefore a mixture of K fixed fields: with B the map from signals to the receiver (`wrf_mi.gaussians.operator`) the
products B C are K fixed images (or element signals), computed once, and a prediction costs one small network and K
terms per pixel, for any number of Gaussians. Source: truncated singular value decomposition (Eckart and Young 1936),
with the right-hand factor given by a network.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import numpy as np

from ..core import InputError
from .fields import GEOMETRY, Encoding
from .initial import InitialGaussians
from .network import Params, Weights, dense, init_layer, linear
from .parameters import Gaussians, common_geometry, logistic


@dataclass(frozen=True)
class Factorised:
    """Static Gaussians with opacity and K complex coefficients each; alpha blending (WRF-GS+, eq. 14).

    Attributes:
        encoding: encoding of the transmitter; Gaussians are not encoded.
        terms: number of functions K.
        layers: hidden layers of the network.
        width: neurons of a hidden layer.
        components: complex signals of a Gaussian, with K coefficients each.
    """

    encoding: Encoding = field(default_factory=Encoding)
    terms: int = 32
    layers: int = 3
    width: int = 128
    components: int = 1

    blending = "alpha"
    static_geometry = True
    per_gaussian = (*GEOMETRY, "opacity", "signal")
    signal_parameters = ("signal", "terms.")

    def __post_init__(self) -> None:
        """Refuse an encoding without features of the transmitter.

        Raises:
            InputError: no octaves.
        """
        if not self.encoding.sizes["transmitter"]:
            raise InputError("setting encoding.tx_octaves: 0 leaves factorised nothing to see; choose 1 or more")

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """Parameters as NumPy arrays; ``signal`` is C, [2 K, n] a component: real, then imaginary parts."""
        weights = initial.geometry()
        weights["opacity"] = initial.opacity_logit()
        deviation = initial.signal / np.sqrt(self.terms)
        drawn = rng.standard_normal((2 * self.terms * self.components, initial.count))
        weights["signal"] = (drawn * deviation).astype(np.float32)
        for i in range(self.layers):
            inputs = {"hidden": self.width} if i else {"transmitter": self.encoding.sizes["transmitter"]}
            weights |= init_layer(f"terms.{i}", inputs, self.width, rng)
        weights |= init_layer("terms.out", {"hidden": self.width}, 2 * self.terms, rng, gain=1.0)
        # The first term starts as a constant.
        weights["terms.out.bias"][0] = 1.0
        return weights

    def functions(self, params: Params, tx_pos: dr.ArrayBase) -> dr.ArrayBase:
        """Values of phi at transmitters [3, batch] in metres: [2 K, batch], real parts, then imaginary ones."""
        hidden = dense(params, "terms.0", self.encoding.transmitter(tx_pos), "transmitter")
        for i in range(1, self.layers):
            hidden = dense(params, f"terms.{i}", hidden)
        return linear(params, "terms.out", hidden)

    def gaussians(self, params: Params, tx_pos: dr.ArrayBase) -> Gaussians:
        """Gaussians for transmitter positions [3, batch] in metres."""
        batch, k, factors = tx_pos.shape[1], self.terms, params["signal"]
        n = factors.shape[1]
        blocks = [factors[i * k : (i + 1) * k, :] for i in range(2 * self.components)]
        c_re, c_im = (dr.concat(blocks[half::2], axis=1) if len(blocks) > 2 else blocks[half] for half in (0, 1))
        # One real product instead of four, in whose derivative Dr.Jit 1.5 on two threads sometimes lost a part.
        both = dr.concat([dr.concat([c_re, c_im], axis=1), dr.concat([-c_im, c_re], axis=1)], axis=0)
        signal = dr.moveaxis(self.functions(params, tx_pos), 0, 1) @ both
        return Gaussians(
            **common_geometry(params),
            signal=[signal[:, i * n : (i + 1) * n].array for i in range(2 * self.components)],
            opacity=logistic(params["opacity"].array),
            attenuation=None,
            batch=batch,
        )
