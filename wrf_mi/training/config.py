"""Settings of fits by gradients: frozen dataclasses, written to and read from ``config.yaml``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, ClassVar, get_type_hints

from numpy.typing import ArrayLike
from pydantic import Field

from ..core import InputError, Split
from ..core.settings import NOT_NEGATIVE, CheckedSettings, Count, Inside, Positive, Share, ShareBelow1, with_settings
from ..gaussians.network import unambiguous_scale
from ..graph.settings import SPLATTED, EvaluationName, TracedConfig
from ..receivers.registry import AUTO
from ..tasks import TASKS

AcuteAngle = Annotated[float, Field(gt=0, lt=90, description="more than 0 and less than 90")]


@dataclass(frozen=True)
class AdamConfig:
    """Adam (Kingma and Ba 2015): warm-up, then a cosine to ``final`` of each rate."""

    network: float = 1e-3  #: rate of all networks
    warm_up: int = 100  #: steps over which rates rise from zero
    cosine_start: Share = 0.0  #: share of the steps after which rates begin to fall
    final: Share = 0.01  #: final factor of each rate
    #: decay per step of the running mean of the parameters, which is evaluated and stored
    ema_decay: ShareBelow1 = 0.999


@dataclass(frozen=True)
class LoopConfig(CheckedSettings):
    """Settings of `wrf_mi.training.loop.TrainingLoop`."""

    steps: Count = 1000  #: optimiser steps
    batch: Count = 1  #: largest number of samples in a step
    #: share of the steps in which the validation rows are kept out of training. 1 keeps them out to the end, as every
    #: choice of settings must; less ends with a fit on all training rows
    holdout_steps_fraction: Share = 0.7
    #: number of scores on the validation rows without improvement after which the fit goes on from the best state with
    #: all training rows, for a share of the steps that led to it. 0: all steps are taken, and the last state counts
    patience: int = 0
    checkpoint_every: Count = 2000  #: steps between two checkpoints
    log_every: Count = 100  #: steps between two lines of the log
    validate_every: Count = 1000  #: steps between two scores on the validation rows
    optimiser: AdamConfig = field(default_factory=AdamConfig)  #: learning rates and running mean


def validates(splits: Sequence[Split]) -> bool:
    """Whether any of the splits keeps rows for validation."""
    return any(len(split.validation) for split in splits)


def unused_of_loop(config: LoopConfig, has_validation: bool) -> dict[str, str]:
    """Settings of the training loop without an effect where no samples choose the state, and why."""
    if not has_validation:
        return dict.fromkeys(("holdout_steps_fraction", "patience"), "no training row is kept for validation")
    return {} if config.holdout_steps_fraction else {"patience": "holdout_steps_fraction=0 leaves no validation rows"}


_OPTIONAL = {name: kind for name, kind in get_type_hints(LoopConfig).items() if name != "optimiser"}


def _chosen(options: Any) -> list[str]:  # settings that are not null, as ``--set`` takes them
    values = {name: getattr(options, name) for name in _OPTIONAL}
    return [f"{name}={value}" for name, value in values.items() if value is not None]


LoopOptions: Any = make_dataclass(
    "LoopOptions",
    [(name, kind | None, None) for name, kind in _OPTIONAL.items()],
    namespace={"chosen": _chosen},
    frozen=True,
)
"""Base of settings of a model that may be trained: those of `LoopConfig`; null: the default of the training."""


@dataclass(frozen=True)
class InitialConfig:
    """Starting values of Gaussians: random, or from one of ``points``, ``mesh`` and ``paths``."""

    gaussians: Count = 270  #: number of Gaussians
    points: str = ""  #: file with a point cloud (.ply, .xyz, .npz with ``points``), world frame, metres
    mesh: str = ""  #: scene (`wrf_mi.tracing.open_scene`) on whose surfaces they start
    paths: str = ""  #: scene whose traced paths of the training transmitters they start from
    size_deg: AcuteAngle = 7.0  #: standard deviation of a random Gaussian as seen from its receiver, degrees
    nearest_m: Positive = 1.0  #: smallest distance of a random Gaussian from its receiver, metres
    farthest_m: Positive = 8.0  #: largest distance, metres
    opacity: Inside = 0.4  #: alpha at a footprint's centre
    signal: Positive = 0.3  #: standard deviation of the starting signals; at 0 no signal would have a gradient


@dataclass(frozen=True)
class EncodingConfig:
    """Positional encoding (`wrf_mi.gaussians.network`)."""

    position_octaves: Count = 4  #: octaves for Gaussians, L + 1 of the paper
    position_scale_m: Positive = 4.0  #: metres per unit for Gaussians
    tx_octaves: int = 4  #: octaves for transmitters
    #: metres per unit for transmitters; 0: the smallest multiple of `LEAST_TX_SCALE_M` that distinguishes all training
    #: transmitters
    tx_scale_m: float = 0.0


@dataclass(frozen=True)
class NetworkConfig:
    """Size of the networks, which dominate a field's size and time."""

    width: int = 0  #: neurons of a layer; 0: the paper's (256 for WRF-GS+, 128 for WRF-GS), 128 for a factorised field
    #: hidden layers; 0: the paper's eight, three for a factorised field. WRF-GS+ joins its input again half-way
    layers: int = 0
    terms: int = 0  #: terms of a factorised field; 0: 32
    #: WRF-GS+ moves only signals with the transmitter, not rotation and scale: the map from signals to the receiver is
    #: then the same for all transmitters
    static_geometry: bool = False

    FIXED: ClassVar[Mapping[str, float]] = {"phase_hz": 0.0}


@dataclass(frozen=True)
class ViewConfig:
    """Directions of a single antenna, which may be coarse as their signals are summed."""

    height: Count = 9  #: elevations of each hemisphere
    columns: Count = 36  #: azimuths
    #: largest number of complex signals of a Gaussian, coefficients of the principal components of channels
    components: Count = 6


@dataclass(frozen=True)
class OptimiserConfig(AdamConfig):
    """Adam with a rate for each parameter group of Gaussians."""

    position: float = 5e-3  #: rate of centres, metres
    scale: float = 5e-3  #: rate of log scales
    rotation: float = 2e-3  #: rate of quaternions
    opacity: float = 2e-2  #: rate of opacity logits
    signal: float = 5e-3  #: rate of static signals
    level: float = 2e-2  #: rate of the logarithm of each receiver's unit of the field, where it has one


@dataclass(frozen=True)
class DensityConfig:
    """Adaptive density control (Kerbl et al. 2023, section 5.2; `wrf_mi.gaussians.initial`)."""

    every: int = 1000  #: steps between two rounds; 0 turns it off
    start: Share = 0.05  #: share of the steps before the first round
    stop: Share = 0.4  #: share of the steps after the last round
    #: share of the Gaussians, those with the largest mean gradient, that are cloned or split in a round
    growth_fraction: Share = 0.05
    max_gaussians: Count = 320  #: largest number of Gaussians
    reset_every: int = 0  #: rounds between two opacity resets; 0 turns them off

    # Constants of `wrf_mi.gaussians.initial`, which run files of earlier versions have as settings.
    FIXED: ClassVar[Mapping[str, float]] = {"split_deg": 5.0, "least_opacity": 0.005, "reset_opacity": 0.05}


@dataclass(frozen=True)
class LossConfig:
    """Loss of the training.

    By default that of the task, of spectra (1 - eta) D + eta (1 - SSIM), after the WRF-GS papers
    (`wrf_mi.tasks.losses.spectrum_loss`).
    """

    ssim_weight: Share = 0.2  #: eta
    name: str = ""  #: name of a loss (`wrf_mi.tasks.LOSSES`); "": the task's


PATHS_ALONE = "ray-tracing"  # name of the model that trains the paths of a scene without Gaussians
LONG_ENOUGH: Mapping[str, int] = {"wrf-gs+": 9000}
"""Steps after which held-out scores no longer improve (docs/speed.md); `OTHERWISE` for other models."""
OTHERWISE = 15000  # models whose number nobody has measured take clearly more than wrf-gs+
LEAST_TX_SCALE_M = 1.0
"""Metres per unit for transmitters within two metres; doubled for wider regions as often as needed."""


@dataclass(frozen=True)
class TrainConfig(LoopConfig):
    """All settings of a fit of Gaussians, of the paths of a scene, or of both.

    Attributes:
        steps: optimiser steps; 0: as in `LONG_ENOUGH`.
        batch: largest number of transmitters in a step.
        model: ``"wrf-gs"``, ``"wrf-gs+"`` or ``"factorised"``.
        seed: seed of starting values and of the order of rows.
        deterministic: bit-identical results from run to run, on one thread of the CPU.
        loss: loss of the training.
        receiver: receiver model (`wrf_mi.receivers.registry`). For spectra ``"pixel"``: magnitude at each direction
            (the papers'), ``"array"``: the Bartlett spectrum of the array's element signals, scaled as the instrument
            does; ``"auto"``: array with a scene, else pixel. For signal strengths ``"power"``, for channels ``"csi"``.
        evaluation: evaluation of Gaussians in steps and predictions: ``"splatted"``, or ``"traced"`` by ``mi.render``
            with the Mitsuba plugins, where walls of a scene attenuate what lies behind them; a step then takes several
            times as long.
        view: directions of an antenna, where observations are not spectra.
        traced: paths that are trained together with the Gaussians, where a scene is given.
        attributes: further attributes of Gaussians that installed packages add (`wrf_mi.gaussians.attributes`), names
            separated by commas.
    """

    steps: Annotated[int, NOT_NEGATIVE] = 0
    optimiser: OptimiserConfig = field(default_factory=OptimiserConfig)
    model: str = "wrf-gs+"
    seed: int = 0
    deterministic: bool = False
    loss: LossConfig = field(default_factory=LossConfig)
    initial: InitialConfig = field(default_factory=InitialConfig)
    encoding: EncodingConfig = field(default_factory=EncodingConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    receiver: str = AUTO
    evaluation: EvaluationName = SPLATTED
    view: ViewConfig = field(default_factory=ViewConfig)
    traced: TracedConfig = field(default_factory=TracedConfig)
    attributes: str = ""

    def resolved(self, tx_pos_m: ArrayLike) -> TrainConfig:
        """The settings with number of steps and scale for the training transmitters [n, 3] in metres."""
        # A scale that encodes two transmitters alike would make the network predict their mean.
        steps = self.steps or LONG_ENOUGH.get(self.model, OTHERWISE)
        scale = self.encoding.tx_scale_m or unambiguous_scale(tx_pos_m, LEAST_TX_SCALE_M)
        return dataclasses.replace(self, steps=steps, encoding=dataclasses.replace(self.encoding, tx_scale_m=scale))

    def __post_init__(self) -> None:
        super().__post_init__()
        sources = [name for name in ("points", "mesh", "paths") if getattr(self.initial, name)]
        if len(sources) > 1:
            raise InputError(f"settings initial.{' and initial.'.join(sources)}: Gaussians start from one; choose it")
        nearest, farthest = self.initial.nearest_m, self.initial.farthest_m
        if nearest > farthest:
            raise InputError(f"setting initial.nearest_m: {nearest} is beyond initial.farthest_m, {farthest}")


PAPER = (
    "encoding.position_octaves=10",
    "encoding.position_scale_m=1",
    "encoding.tx_octaves=10",
    "encoding.tx_scale_m=1",
)
"""Settings of the paper that differ from the defaults: L = 9 for Gaussians and transmitter (section V-A).

The paper states no scale of coordinates; metres are assumed. Loss, networks and Adam are the paper's by default.
"""

FAST = ("steps=6500", "initial.gaussians=250", "network.layers=6", "density.every=0", "optimiser.ema_decay=0.998")
"""Half of the time for a hundredth of the median SSIM of `rfid-lab`: fewer steps of smaller networks.

Validation rows that never train: 0.968, 0.959 of `rfid-lab`, by which it was chosen, and 0.976, 0.986, 0.985 of a
cluttered room that served for nothing else; with 150 Gaussians, 8 layers and 6,000 steps 0.963, 0.951 and 0.973, 0.987,
0.982.
"""

PATHS = ("steps=500", "batch=128", "holdout_steps_fraction=0.9", "validate_every=50", "patience=8", "density.every=0")
"""Settings of paths alone: few parameters converge soon."""
HELD = ("traced.gain=0", "traced.material=0", "traced.pattern=0", "traced.surface=0")
CALIBRATED: Mapping[str, tuple[str, ...]] = {
    "gain": ("traced.gain=0.05",),
    "materials": ("traced.material=0.05",),
    "planes": ("traced.shift=1e-3", "traced.tilt=5e-4"),
    "patterns": ("traced.pattern=0.03", "traced.pattern_degree=3"),
    "pose": ("traced.position=1e-3", "traced.turn=1e-3"),
    "surface": ("traced.surface=0.02",),
}
"""Parameter groups of the traced component that a calibration may train, by name; rates as ``--set`` takes them."""


def default_config(task: str, with_scene: bool = False) -> TrainConfig:
    """Default settings for a task, without or with the paths of a scene."""
    kind = TASKS[task]
    return with_settings(TrainConfig(), kind.settings_with_scene if with_scene else kind.settings)


def calibration_config(groups: Iterable[str], further: Iterable[str] = ()) -> TrainConfig:
    """The settings of a fit of paths alone, of parameter groups of `CALIBRATED`.

    ``further`` are those of the task (`wrf_mi.core.Task.settings_of_paths`).

    Raises:
        InputError: no group, or an unknown one.
    """
    chosen = tuple(groups)
    unknown = [group for group in chosen if group not in CALIBRATED]
    if unknown or not chosen:
        raise InputError(f"calibration {','.join(unknown) or 'of nothing'}: choose of {', '.join(CALIBRATED)}")
    # All groups are held first, as the settings of paths train some of them by default.
    moved = [setting for group in chosen for setting in CALIBRATED[group]]
    return with_settings(TrainConfig(), [f"model={PATHS_ALONE}", *PATHS, *further, *HELD, *moved])


BEST = ("steps=15000",)  # two thirds more time for a few thousandths of the median SSIM
PRESETS: Mapping[str, tuple[str, ...]] = {"fast": FAST, "default": (), "best": BEST, "paper": PAPER}
"""Named sets of settings, as ``--set`` takes them."""
