"""Settings of the traced side of a graph, plain values that a configuration file states."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TracedConfig:
    """Paths of a scene that are trained together with the Gaussians: what is traced, and learning rates.

    A parameter of rate 0 is held at its stated value and costs nothing.

    Attributes:
        depth: interactions of a path at most, transmissions included.
        reflections: of these at most so many reflections.
        transmission: paths through surfaces.
        rays: that search from each receiver.
        pattern_degree: degree of trainable factors of the antennas' patterns; 0: none.
        material: rate of permittivities and conductivities (of their logarithms).
        gain: rate of each receiver's gain (of its logarithm, and of its phase in rad).
        pattern: rate of the patterns' coefficients.
        position: rate of the receivers' positions, metres.
        turn: rate of the receivers' orientations, rad.
    """

    depth: int = 3
    reflections: int = 2
    transmission: bool = True
    rays: int = 1 << 16
    pattern_degree: int = 0
    material: float = 0.02
    gain: float = 0.01
    pattern: float = 0.01
    position: float = 0.0
    turn: float = 0.0

    def rate(self, name: str) -> float:
        """Learning rate of a parameter of `wrf_mi.hybrid.traced.TracedField.parameters`."""
        kind, last = name.partition(".")[0], name.rpartition(".")[2]
        if kind == "material":
            return self.material
        if kind == "pattern":
            return self.pattern
        return {"gain": self.gain, "position": self.position, "turn": self.turn}[last]


DEFAULT = TracedConfig()
