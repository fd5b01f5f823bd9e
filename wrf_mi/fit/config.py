"""The settings of a fit: frozen dataclasses, written to and read from ``config.yaml``."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from numpy.typing import ArrayLike

from ..core import InputError
from ..core.settings import flat, with_settings
from ..field.encoding import telling_scale
from ..graph.receivers import AUTO
from ..graph.settings import SPLATTED, TRACED, EvaluationName, TracedConfig
from ..splat.skip import Skip
from ..trace.options import MAX_DEGREE, MAX_DEPTH, MAX_RAYS


@dataclass(frozen=True)
class InitialConfig:
    """Where Gaussians start.

    Attributes:
        gaussians: how many.
        points: file with a point cloud (.ply, .xyz, .npz with ``points``), world frame, metres: on its points.
        mesh: scene that `wrf_mi.trace.open_scene` opens: on its surfaces.
        paths: such a scene: where traced paths of the training transmitters come from. Of the three one at most;
            with none of them Gaussians start at random.
        size_deg: standard deviation of a random Gaussian as its receiver sees it, degrees.
        nearest_m: smallest distance of a random Gaussian from its receiver, metres.
        farthest_m: largest distance, metres.
        opacity: alpha at a footprint's centre.
        signal: deviation of the starting signals; 0: `SIGNAL_ALONE`, or `SIGNAL_WITH_SCENE` together with a scene.
    """

    gaussians: int = 270
    points: str = ""
    mesh: str = ""
    paths: str = ""
    size_deg: float = 7.0
    nearest_m: float = 1.0
    farthest_m: float = 8.0
    opacity: float = 0.4
    signal: float = 0.0


@dataclass(frozen=True)
class EncodingConfig:
    """Positional encoding (`wrf_mi.field.encoding`).

    Attributes:
        position_octaves: of Gaussians, L + 1 of the paper.
        position_scale_m: metres per unit, of Gaussians.
        tx_octaves: of transmitters.
        tx_scale_m: metres per unit, of transmitters; 0: as many as tell all training transmitters apart, see
            `LEAST_TX_SCALE_M`.
    """

    position_octaves: int = 4
    position_scale_m: float = 4.0
    tx_octaves: int = 4
    tx_scale_m: float = 0.0


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the networks, which are most of a field's size and time.

    Attributes:
        width: neurons of a layer; 0: the paper's (256 for WRF-GS+, 128 for WRF-GS), 128 for a factorised field.
        layers: hidden layers; 0: the paper's eight, three for a factorised field. WRF-GS+ joins its input again
            half-way.
        terms: of a factorised field; 0: 32.
        still: WRF-GS+ moves signals alone with the transmitter, not rotation and scale: the map from signals to
            the receiver is then the same for all transmitters.
        phase_hz: carrier frequency of a phase that signals of WRF-GS+ have from the distance of the transmitter's
            image, which ``initial.paths`` tells, else of the transmitter; 0: none.
    """

    width: int = 0
    layers: int = 0
    terms: int = 0
    still: bool = False
    phase_hz: float = 0.0


@dataclass(frozen=True)
class ViewConfig:
    """The field as one antenna sees it: all directions end in one number, so they may be coarse.

    Attributes:
        height: elevations of each hemisphere.
        columns: azimuths.
        components: complex signals of a Gaussian at most, coefficients of the principal components of channels.
    """

    height: int = 9
    columns: int = 36
    components: int = 6


@dataclass(frozen=True)
class OptimiserConfig:
    """Adam (Kingma and Ba 2015): one rate a parameter group, warm-up, then a cosine to ``final`` of each rate.

    Attributes:
        network: rate of all networks.
        position: rate of centres, metres.
        scale: rate of log scales.
        rotation: rate of quaternions.
        opacity: rate of opacity logits.
        signal: rate of static signals.
        level: rate of the logarithm of the unit in which each receiver sees the field, where it has one.
        warm_up: steps over which rates rise from zero.
        final: share of each rate that is left at the last step.
        averaging: decay per step of the running mean of the parameters, which is what is evaluated and stored.
    """

    network: float = 1e-3
    position: float = 5e-3
    scale: float = 5e-3
    rotation: float = 2e-3
    opacity: float = 2e-2
    signal: float = 5e-3
    level: float = 2e-2
    warm_up: int = 100
    final: float = 0.01
    averaging: float = 0.999


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (Kerbl et al. 2023, section 5.2), see `wrf_mi.field.density`.

    Attributes:
        every: steps between two rounds; 0 turns it off.
        start: share of the steps before the first round.
        stop: share of the steps after the last round.
        grow: share of the Gaussians, those with the largest mean gradient, that are cloned or split in a round.
        most: number of Gaussians that is never passed.
        split_deg: a grown Gaussian larger than this is split, a smaller one cloned, degrees.
        least_opacity: a Gaussian below this is pruned (alpha blending).
        reset_every: rounds between two opacity resets; 0 turns them off.
        reset_opacity: opacity that a reset leaves at most.
    """

    every: int = 1000
    start: float = 0.05
    stop: float = 0.4
    grow: float = 0.05
    most: int = 320
    split_deg: float = 5.0
    least_opacity: float = 0.005
    reset_every: int = 0
    reset_opacity: float = 0.05


PATHS_ALONE = "ray-tracing"
"""Name of the model that trains the paths of a scene without Gaussians."""
LONG_ENOUGH: Mapping[str, int] = {"wrf-gs+": 9000}
"""Steps after which more gain nothing on held-out rows (docs/speed.md); `OTHERWISE` for a model that is not here."""
OTHERWISE = 15000
SIGNAL_ALONE, SIGNAL_WITH_SCENE = 0.3, 0.02
"""Deviation of the starting signals: together with a scene the Gaussians add next to nothing to its paths at first."""
LEAST_TX_SCALE_M = 1.0
"""Metres per unit of transmitters within two metres; doubled for wider ones as often as needed."""


@dataclass(frozen=True)
class TrainConfig:
    """All settings of a fit.

    Attributes:
        model: ``"wrf-gs"``, ``"wrf-gs+"`` or ``"factorised"``.
        steps: optimiser steps; 0: as many as the model needs, see `LONG_ENOUGH`.
        batch: transmitters in a step, at most.
        seed: of starting values and of the order of rows.
        deterministic: bit-identical results from run to run, at the price of computing on one thread of the CPU.
        hold_out: share of the steps in which the validation rows are kept out of training. 1 keeps them out
            to the end, as every choice of settings must; less ends with a fit on all training rows.
        patience: scores on the validation rows without a better one after which no more are waited for. From the best
            of them the fit then goes on with all training rows, for a share of the steps that led there. 0: all steps
            are taken, and the last ones count.
        structural_weight: eta of the loss (1 - eta) L1 + eta (1 - SSIM).
        checkpoint_every: steps between two checkpoints.
        log_every: steps between two lines of the log.
        validate_every: steps between two scores on the validation rows.
        receiver: how the field becomes what is observed, a name of `wrf_mi.graph.receivers`. Of spectra ``"pixel"``:
            its magnitude at each direction (the papers'), ``"array"``: the Bartlett spectrum of the array's element
            signals, scaled as the instrument does; ``"auto"``: array with a scene, else pixel. Of signal strengths
            ``"power"``, of channels ``"csi"``.
        evaluation: how Gaussians become signals on directions, in steps and predictions alike: ``"splatted"``, or
            ``"traced"`` by ``mi.render`` with the Mitsuba plugins, where walls of a scene attenuate what is behind
            them; a step then takes several times as long, and nothing is skipped.
        view: how an antenna sees the field, where observations are no spectra.
        skip: what predictions do not evaluate, and the error that this may make in a grey; steps evaluate all.
        traced: paths that are trained together with the Gaussians, where a scene is given.
    """

    model: str = "wrf-gs+"
    steps: int = 0
    batch: int = 1
    seed: int = 0
    deterministic: bool = False
    hold_out: float = 0.7
    patience: int = 0
    structural_weight: float = 0.2
    checkpoint_every: int = 2000
    log_every: int = 100
    validate_every: int = 1000
    initial: InitialConfig = field(default_factory=InitialConfig)
    encoding: EncodingConfig = field(default_factory=EncodingConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    receiver: str = AUTO
    evaluation: EvaluationName = SPLATTED
    view: ViewConfig = field(default_factory=ViewConfig)
    skip: Skip = field(default_factory=Skip)
    traced: TracedConfig = field(default_factory=TracedConfig)

    def resolved(self, tx_pos_m: ArrayLike, with_scene: bool = False) -> TrainConfig:
        """The same with the number of steps, the scale of transmitters and the starting signals that are meant.

        Args:
            tx_pos_m: training transmitters [n, 3], metres.
            with_scene: whether paths of a scene are trained together with the Gaussians.
        """
        steps = self.steps or LONG_ENOUGH.get(self.model, OTHERWISE)
        scale = self.encoding.tx_scale_m or telling_scale(tx_pos_m, LEAST_TX_SCALE_M)
        signal = self.initial.signal or (SIGNAL_WITH_SCENE if with_scene else SIGNAL_ALONE)
        initial = dataclasses.replace(self.initial, signal=signal)
        encoding = dataclasses.replace(self.encoding, tx_scale_m=scale)
        return dataclasses.replace(self, steps=steps, initial=initial, encoding=encoding)

    def __post_init__(self) -> None:
        """Refuse values that no fit can use."""
        values = dict(flat(dataclasses.asdict(self), ""))
        for name, value in values.items():
            if not isinstance(value, int | float):
                continue
            good, words = _RANGES.get(name, _NOT_NEGATIVE)
            if not math.isfinite(value) or not good(value):
                raise InputError(f"setting {name}: {value} is out of range, choose {words}")
        sources = [name for name in ("points", "mesh", "paths") if values[f"initial.{name}"]]
        if len(sources) > 1:
            raise InputError(f"settings initial.{' and initial.'.join(sources)}: Gaussians start from one; choose it")
        nearest, farthest = values["initial.nearest_m"], values["initial.farthest_m"]
        if nearest > farthest:
            raise InputError(f"setting initial.nearest_m: {nearest} is beyond initial.farthest_m, {farthest}")
        if self.evaluation == TRACED and self.skip.error:
            raise InputError("settings skip.contribution and skip.rest belong to evaluation=splatted; set them to 0")


_Range = tuple[Callable[[float], bool], str]
_COUNT: _Range = (lambda x: x >= 1, "1 or more")
_POSITIVE: _Range = (lambda x: x > 0, "more than 0")
_INSIDE: _Range = (lambda x: 0 < x < 1, "more than 0 and less than 1")
_SHARE: _Range = (lambda x: 0 <= x <= 1, "0 to 1")
_NOT_NEGATIVE: _Range = (lambda x: x >= 0, "0 or more")

_RANGES: Mapping[str, _Range] = {
    "batch": _COUNT,
    "hold_out": _SHARE,
    "structural_weight": _SHARE,
    "checkpoint_every": _COUNT,
    "log_every": _COUNT,
    "validate_every": _COUNT,
    "initial.gaussians": _COUNT,
    "initial.size_deg": (lambda x: 0 < x < 90, "more than 0 and less than 90"),
    "initial.nearest_m": _POSITIVE,
    "initial.farthest_m": _POSITIVE,
    "initial.opacity": _INSIDE,
    "encoding.position_octaves": _COUNT,
    "encoding.position_scale_m": _POSITIVE,
    "view.height": _COUNT,
    "view.columns": _COUNT,
    "view.components": _COUNT,
    "optimiser.final": _SHARE,
    "optimiser.averaging": (lambda x: 0 <= x < 1, "0 or more and less than 1"),
    "density.start": _SHARE,
    "density.stop": _SHARE,
    "density.grow": _SHARE,
    "density.most": _COUNT,
    "density.split_deg": _POSITIVE,
    "density.least_opacity": _INSIDE,
    "density.reset_opacity": _INSIDE,
    "traced.depth": (lambda x: 0 <= x <= MAX_DEPTH, f"0 to {MAX_DEPTH}"),
    "traced.rays": (lambda x: 1 <= x <= MAX_RAYS, f"1 to {MAX_RAYS}"),
    "traced.pattern_degree": (lambda x: 0 <= x <= MAX_DEGREE, f"0 to {MAX_DEGREE}"),
}
"""What numbers may be, and words for it; `_NOT_NEGATIVE` where nothing is said here."""


PAPER = (
    "encoding.position_octaves=10",
    "encoding.position_scale_m=1",
    "encoding.tx_octaves=10",
    "encoding.tx_scale_m=1",
)
"""What the paper states and the defaults depart from: L = 9 for Gaussians and transmitter (section V-A).

It states no scale of coordinates; metres are taken. The loss, the networks and Adam are the paper's anyway.
"""

QUICK = ("steps=6000",)
"""The shorter schedule of the demo."""

ONE_ANTENNA = (
    "batch=16",
    "steps=18000",
    "initial.gaussians=60",
    "initial.size_deg=15",
    "network.width=64",
    "network.layers=4",
    "density.every=0",
    "validate_every=500",
    "patience=8",
)
"""What a field of signal strengths or channels departs from one of spectra in: it ends in few numbers."""
PATHS = ("steps=500", "batch=128", "hold_out=0.9", "validate_every=50", "patience=8", "density.every=0")
"""What paths alone depart in: few parameters are fitted, soon."""
PATHS_OF_IMAGES = ("batch=8",)
"""And where observations are images, each of thousands of numbers."""
HELD = ("traced.gain=0", "traced.material=0", "traced.pattern=0")
CALIBRATED: Mapping[str, tuple[str, ...]] = {
    "gain": ("traced.gain=0.05",),
    "materials": ("traced.material=0.05",),
    "planes": ("traced.shift=1e-3", "traced.tilt=5e-4"),
    "patterns": ("traced.pattern=0.03", "traced.pattern_degree=3"),
    "pose": ("traced.position=1e-3", "traced.turn=1e-3"),
}
"""What of the traced side can be fitted, by name; rates as ``--set`` takes them."""
OF_TASK: Mapping[str, tuple[str, ...]] = {"rssi": ONE_ANTENNA, "csi": ONE_ANTENNA}
"""Settings of tasks other than spectra, as ``--set`` takes them."""


def default_config(task: str) -> TrainConfig:
    """The settings that a fit to a task's observations begins with."""
    return with_settings(TrainConfig(), OF_TASK.get(task, ()))


def calibration_config(parts: Iterable[str], images: bool = False) -> TrainConfig:
    """The settings of a fit of paths alone.

    Args:
        parts: what is fitted, of `CALIBRATED`; all else is held.
        images: whether observations are images.

    Raises:
        InputError: none of these, or nothing.
    """
    chosen = tuple(parts)
    unknown = [part for part in chosen if part not in CALIBRATED]
    if unknown or not chosen:
        raise InputError(f"calibration {','.join(unknown) or 'of nothing'}: choose of {', '.join(CALIBRATED)}")
    moved = [setting for part in chosen for setting in CALIBRATED[part]]
    own = PATHS_OF_IMAGES if images else ()
    return with_settings(TrainConfig(), [f"model={PATHS_ALONE}", *PATHS, *own, *HELD, *moved])


PRESETS: Mapping[str, tuple[str, ...]] = {"default": (), "paper": PAPER, "quick": QUICK}
"""Named sets of settings, as ``--set`` takes them."""
