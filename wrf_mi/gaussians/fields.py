"""The two fields of the paper, WRF-GS and WRF-GS+, and a factorised one.

A field is a description without arrays: ``init`` makes its parameters as NumPy arrays, ``gaussians`` maps
parameters (a dictionary of Dr.Jit tensors) and transmitter positions to `Gaussians`. Both work in
whatever float type the tensors have.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import numpy as np

from ..core import InputError
from .initial import InitialGaussians
from .network import Params, Weights, dense, dense_of_pairs, encode, encoded_size, init_layer, linear
from .parameters import Gaussians, common_geometry, logistic, rows, scheduled

GEOMETRY = ("position", "log_scale", "rotation")
"""Per-Gaussian parameters that every field has, tensors [3, n], [3, n], [4, n].

A field whose geometry and attenuation do not depend on the transmitter has ``static_geometry`` true, and lists in
``signal_parameters`` the prefixes of the parameters that affect only its signals.
"""


@dataclass(frozen=True)
class Encoding:
    """Positional encoding of Gaussians and transmitters.

    The paper has ten octaves (L = 9) for both and names no scale of coordinates; see `wrf_mi.gaussians.network`.

    Attributes:
        position_octaves: octaves of Gaussian centres.
        position_scale_m: unit of Gaussian centres, metres.
        tx_octaves: octaves of transmitter positions.
        tx_scale_m: unit of transmitter positions, metres.
        features: number of features that replace the encoded transmitter (the uplink channel in the second case study
            of WRF-GS+); 0: the transmitter's position is encoded.
        carrier: whether a last row of conditions, the logarithm of the carrier, is a feature, too.
    """

    position_octaves: int = 10
    position_scale_m: float = 1.0
    tx_octaves: int = 10
    tx_scale_m: float = 1.0
    features: int = 0
    carrier: bool = False

    def position(self, points: dr.ArrayBase) -> dr.ArrayBase:
        """Encoded Gaussian centres [6 * octaves, n], detached."""
        # The network does not move Gaussians: its gradient through the fast octaves would outweigh the one through the
        # footprint (as in Deformable 3D Gaussians, Yang et al. 2024).
        return encode(dr.detach(points), self.position_octaves, self.position_scale_m)

    def transmitter(self, points: dr.ArrayBase) -> dr.ArrayBase:
        """Encoded transmitter positions [6 * octaves, batch], or features [features, batch]; with the carrier below."""
        if self.features or not self.carrier:
            return points if self.features else encode(points, self.tx_octaves, self.tx_scale_m)
        return dr.concat([encode(points[:3], self.tx_octaves, self.tx_scale_m), points[3:]], axis=0)

    @property
    def sizes(self) -> dict[str, int]:
        """Number of features of each part."""
        return {
            "position": encoded_size(self.position_octaves),
            "transmitter": (self.features or encoded_size(self.tx_octaves)) + self.carrier,
        }


@dataclass(frozen=True)
class WrfGs:
    """WRF-GS (paper, section IV-B): attenuation and signal from two networks, product blending (eq. 12, 13).

    The first network, eight layers of 128, sees the Gaussian's centre and gives its complex attenuation and a
    feature vector; the second, layers of 128 and 64, sees features and transmitter and gives the signal.
    Where the paper is silent: the feature vector has ``width`` entries; centre, scale and rotation are
    learned as in 3D Gaussian splatting; delta = z / sqrt(1 + |z|^2) keeps |delta| < 1 and starts at
    0.9 (nearly transparent), so that Gaussians far away are seen from the first step.
    With several ``components`` a Gaussian has as many complex signals: real parts, then imaginary ones.
    """

    encoding: Encoding = Encoding()
    layers: int = 8
    width: int = 128
    signal_widths: tuple[int, int] = (128, 64)
    components: int = 1

    blending = "product"
    per_gaussian = GEOMETRY
    static_geometry = True
    signal_parameters = ("signal.",)

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """Parameters as NumPy arrays: geometry from ``initial``, networks drawn from ``rng``."""
        sizes, weights = self.encoding.sizes, initial.geometry()
        weights |= init_layer("attenuation.0", {"position": sizes["position"]}, self.width, rng)
        for i in range(1, self.layers):
            weights |= init_layer(f"attenuation.{i}", {"hidden": self.width}, self.width, rng)
        # z starts near 2, where |delta| = 2 / sqrt(5) = 0.9.
        weights |= init_layer("attenuation.delta", {"hidden": self.width}, 2, rng, gain=0.1)
        weights["attenuation.delta.bias"][0] = 2.0
        first, second = self.signal_widths
        weights |= init_layer("signal.0", {"feature": self.width, "transmitter": sizes["transmitter"]}, first, rng)
        weights |= init_layer("signal.1", {"hidden": first}, second, rng)
        return weights | init_layer("signal.out", {"hidden": second}, 2 * self.components, rng, gain=initial.signal)

    def features(self, params: Params) -> dr.ArrayBase:
        """Feature vectors of the Gaussians, [width, n]."""
        hidden = dense(params, "attenuation.0", self.encoding.position(params["position"]), "position")
        for i in range(1, self.layers):
            hidden = dense(params, f"attenuation.{i}", hidden)
        return hidden

    def gaussians(self, params: Params, tx_pos: dr.ArrayBase) -> Gaussians:
        """Gaussians for transmitter positions [3, batch] in metres."""
        scheduled(params)
        # The first network sees Gaussians alone: once for all transmitters of the batch.
        batch, hidden = tx_pos.shape[1], self.features(params)
        z = linear(params, "attenuation.delta", hidden)
        re, im = rows(z)
        # delta = z / sqrt(1 + |z|^2): |delta| < 1, so that a Gaussian never amplifies what lies behind it.
        norm = dr.rsqrt(1 + dr.square(re) + dr.square(im))
        encoded = {"transmitter": self.encoding.transmitter(tx_pos)}
        # The only layers that grow with the pairs of Gaussian and transmitter.
        hidden = dense_of_pairs(params, "signal.0", {"feature": hidden}, encoded)
        signal = linear(params, "signal.out", dense(params, "signal.1", hidden))
        return Gaussians(
            **common_geometry(params),
            signal=rows(signal),
            opacity=None,
            attenuation=[re * norm, im * norm],
            batch=batch,
        )


@dataclass(frozen=True)
class WrfGsPlus:
    """WRF-GS+ (paper, section V): static attributes and a deformation network, alpha blending (eq. 14).

    The network has eight ReLU layers of 256; the input joins the fourth layer's output again at the fifth; three linear
    heads give offsets of signal, rotation and scale for each pair of Gaussian and transmitter. With ``static_geometry``
    only the first head is present: the map from the Gaussians' signals to the receiver is then common to all
    transmitters. Where the paper is silent: the scale's offset, bounded to -1..1 by x / sqrt(1 + x^2), is added to its
    logarithm (a scale stays within a factor of e of the static scale), the rotation's to the quaternion before it is
    normalised; the heads start small, so that the static field dominates at first. With several
    ``components`` a Gaussian has as many complex signals: real parts, then imaginary ones.
    """

    encoding: Encoding = Encoding()
    layers: int = 8
    width: int = 256
    skip: int = 4
    static_geometry: bool = False
    components: int = 1

    blending = "alpha"
    per_gaussian = (*GEOMETRY, "opacity", "signal")
    signal_parameters = ("signal", "deform.")

    @property
    def heads(self) -> tuple[tuple[str, int, float], ...]:
        """Name, size and starting gain of each head."""
        moving = () if self.static_geometry else (("rotation", 4, 0.05), ("scale", 3, 0.05))
        return (("signal", 2 * self.components, 0.5), *moving)

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """Parameters as NumPy arrays: static attributes from ``initial``, network drawn from ``rng``."""
        sizes, weights = self.encoding.sizes, initial.geometry()
        weights["opacity"] = initial.opacity_logit()
        weights["signal"] = np.concatenate([initial.static_signal(rng) for _ in range(self.components)])
        for i in range(self.layers):
            inputs = ({"hidden": self.width} if i else {}) | (sizes if i in (0, self.skip) else {})
            weights |= init_layer(f"deform.{i}", inputs, self.width, rng)
        for head, size, gain in self.heads:
            weights |= init_layer(f"deform.{head}", {"hidden": self.width}, size, rng, gain=gain * initial.signal)
        return weights

    def gaussians(self, params: Params, tx_pos: dr.ArrayBase) -> Gaussians:
        """Gaussians for transmitter positions [3, batch] in metres."""
        scheduled(params)
        batch = tx_pos.shape[1]
        position = {"position": self.encoding.position(params["position"])}
        transmitter = {"transmitter": self.encoding.transmitter(tx_pos)}
        hidden = dense_of_pairs(params, "deform.0", position, transmitter)
        for i in range(1, self.layers):
            if i == self.skip:
                hidden = dense_of_pairs(params, f"deform.{i}", position, transmitter, hidden)
            else:
                hidden = dense(params, f"deform.{i}", hidden)
        # Every head is one small product of the last layer; what a static geometry does not need is not computed.
        offset = {head: rows(linear(params, f"deform.{head}", hidden)) for head, _, _ in self.heads}

        def deformed(name: str, head: str) -> list[dr.ArrayBase]:
            if head not in offset:
                return rows(params[name])
            # Batch-major as the network's columns: b * n + i.
            static = [dr.tile(a, batch) for a in rows(params[name])]
            return [a + d for a, d in zip(static, offset[head], strict=True)]

        if "scale" in offset:
            # x / sqrt(1 + x^2): the network is common to all Gaussians. Where most pixels are to be darker, an offset
            # without bounds shrinks all Gaussians in tens of steps: they lie between the pixels, without a gradient.
            offset["scale"] = [d * dr.rsqrt(1 + dr.square(d)) for d in offset["scale"]]
        opacity = logistic(params["opacity"].array)
        return Gaussians(
            position=rows(params["position"]),
            scale=[dr.exp(s) for s in deformed("log_scale", "scale")],
            rotation=deformed("rotation", "rotation"),
            signal=deformed("signal", "signal"),
            opacity=opacity if self.static_geometry else dr.tile(opacity, batch),
            attenuation=None,
            batch=batch,
        )


@dataclass(frozen=True)
class Factorised:
    """Static Gaussians whose signals are mixtures of K functions of the transmitter; alpha blending (WRF-GS+, eq. 14).

        S_i(tx) = sum_k C_ik phi_k(tx),   k = 1..K

    phi is a small network of the encoded transmitter, C_ik are complex parameters of the Gaussians. The received field
    is a mixture of K fixed fields: with B the map from signals to the receiver (`wrf_mi.gaussians.operator`) the
    products B C are K fixed images (or element signals), computed once, and a prediction costs one small network and K
    terms per pixel, for any number of Gaussians. Source: truncated singular value decomposition (Eckart and Young
    1936), with the right-hand factor given by a network.

    Attributes:
        encoding: encoding of the transmitter; Gaussians are not encoded.
        terms: number of functions K.
        layers: hidden layers of the network.
        width: neurons of a hidden layer.
        components: complex signals of a Gaussian, with K coefficients each.

    Raises:
        InputError: an encoding without features of the transmitter.
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
        if not self.encoding.sizes["transmitter"]:
            raise InputError("setting encoding.tx_octaves: 0 leaves factorised nothing to see; choose 1 or more")

    def init(self, initial: InitialGaussians, rng: np.random.Generator) -> Weights:
        """Parameters as NumPy arrays; ``signal`` is C, [2 K, n] a component: real, then imaginary parts."""
        weights = initial.geometry()
        weights["opacity"] = initial.opacity_logit()
        # Sums of K terms of this deviation have the deviation of a static signal.
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
        scheduled(params)
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
