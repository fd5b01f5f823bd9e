"""R2F2: the downlink from path parameters that an optimisation finds in the uplink.

Source: Vasisht, Kumar, Rahul and Katabi, "Eliminating channel feedback in next-generation cellular networks" (SIGCOMM
2016), sections 4 and 5: a channel is a sum over few paths, each of a length, a direction and a complex gain; the paths
that fit the uplink best over all antennas and subcarriers, added one by one from peaks of a matched filter and refined
by non-linear least squares, are evaluated at the downlink's frequencies. Differences from the paper:

- Paths are fitted to antennas and subcarriers themselves, for any array; the paper's transform of a uniform line of
  antennas to angles is unitary, so that the least squares are the same.
- The paper has a line of a few antennas in the far field and known frequencies. For other data the wave model with the
  best downlink of a few validation rows is chosen: spherical waves, plane waves or a gain for each antenna (the latter
  without known elements). Without known frequencies, bands that follow each other at once are compared with bands that
  have a subcarrier between them, the carrier of 802.11.
- The Bayesian information criterion chooses the number of paths up to ``max_paths``; the paper sets a threshold of the
  residual.
- With a scene the paths of its mesh start the search, and their lengths and directions have a prior (`ScenePaths`).
- Gains have priors, too, each of a power of its own (`wrf_mi.estimators.uplink.uplink_paths.expected_gains`).
- The solver is Levenberg and Marquardt's with exact derivatives (`wrf_mi.estimators.uplink.uplink_paths`).

Training rows choose the kind of wave front alone. The method is exact on noise-free channels of few, well separated
paths. Where paths are many or closer than the resolution of array and band, the error grows with the distance of the
bands.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ...core import Antenna, InputError, Prediction, Receiver, Record, Split
from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, Count, Positive, names_of
from ...core.stored import NOT_STORED
from ...core.types import IntArray
from ...tracing.options import SpecularOptions, TraceOptions, without_effect
from ...training.session import FitSession, OnProgress
from ..model import Fitted, Inputs, Problem, slices
from .uplink_paths import Start, UplinkPaths, expected_gains, find_paths, in_parts
from .uplink_waves import (
    Bands,
    Complex,
    UplinkModel,
    Waves,
    bands_of,
    principal_axes,
    relative_error,
    unused_spacing,
    waves_of,
)

CHUNK_SIZE = 256  # positions that are traced together
LENGTH_SD_M, COSINE_SD = 0.3, 0.03
"""Standard deviations of a path's length and its direction's cosines, by a mesh that is some centimetres off."""
ALIKE_M, ALIKE_COSINE = 0.02, 0.01  # paths that differ by less count as one
FAINT = 10 ** (-50 / 20)  # least amplitude of a path, as a share of the root mean square of all
MOST = 70  # most traced paths of a row, the strongest
NEEDED = 1e-4  # least power of a path in the uplink, as a share of the strongest path's


class ScenePaths:
    """Paths of a scene from transmitters to a receiver, as the start of the search in an uplink.

    Over a band of some megahertz an uplink tells directions well, but lengths only to metres, and the phase between the
    bands turns with the length. A mesh that is centimetres off knows lengths far better. Gains are those of the uplink
    alone: materials are not needed.
    """

    def __init__(self, scene: Any, receiver: Receiver, tx_antenna: Antenna, options: TraceOptions) -> None:
        from ...tracing.paths.solve import Prepared
        from ...tracing.paths.traced_field import TracedOptions

        assert receiver.array_m is not None
        self._scene, self._receiver, self._prepared = scene, receiver, Prepared(scene)
        self._options = TracedOptions(options, tx_antenna=tx_antenna)
        self._centre, self._axes = receiver.array_m.mean(axis=0), principal_axes(receiver.array_m)

    def __call__(self, waves: Waves, h: Complex, tx_pos_m: FloatArray, heading_rad: FloatArray | None) -> Start:
        """Paths that explain uplinks [n, antennas, f] of transmitters [n, 3], metres, with yaw [n] in rad or None.

        Raises:
            InputError: positions that are not known, or inside a solid.
        """
        if not np.isfinite(tx_pos_m).all():
            raise InputError("r2f2 with a scene: traces from positions; give finite x, y, z in metres for every row")
        rows = list(self._rows(tx_pos_m, heading_rad))
        theta = np.zeros((len(rows), max(1, *map(len, rows)), 1 + len(self._axes)))
        theta[..., 0] = 1.0  # of absent paths: any length that is not zero
        present = np.zeros(theta.shape[:2], bool)
        for number, row in enumerate(rows):
            theta[number, : len(row)], present[number, : len(row)] = row, True

        def needed(part: slice) -> Any:
            solved = waves.solve(theta[part], present[part], h[part])
            return expected_gains(waves, h[part], present[part], solved)[1]

        # The scene has more paths than matter: those that the uplink, too, gives power to.
        power = np.concatenate(in_parts(needed, len(h)))
        present &= power > NEEDED * power.max(axis=1, keepdims=True)
        order = np.argsort(~present, axis=1, kind="stable")[:, : max(1, int(present.sum(axis=1).max()))]
        theta = np.take_along_axis(theta, order[..., None], axis=1)
        precision = np.broadcast_to(np.r_[LENGTH_SD_M, np.full(len(self._axes), COSINE_SD)] ** -2.0, theta.shape)
        return Start(theta, np.take_along_axis(present, order, axis=1), precision)

    def _rows(self, tx_pos_m: FloatArray, heading_rad: FloatArray | None) -> Iterator[FloatArray]:
        """Lengths and direction cosines [k, p] of each transmitter's paths, seen from the middle of the array."""
        from ...tracing.paths.traced_field import TracedField

        for part in slices(len(tx_pos_m), CHUNK_SIZE):
            turned = None if heading_rad is None else heading_rad[part]
            self._prepared.check(tx_pos_m[part], (self._receiver,))
            link = tx_pos_m[part], self._receiver, self._options, turned
            traced = TracedField(self._scene, *link, prepared=self._prepared)
            paths = traced({})
            shape = paths.batch, paths.each
            amplitude = np.hypot(*(component.numpy() for component in paths.gain)).reshape(shape)
            arrival = np.stack([u.numpy() for u in paths.arrival], axis=-1).reshape(*shape, 3)
            # The image source, from which a spherical wave has the length and direction of the path.
            source = arrival * paths.length_m.numpy().reshape(*shape, 1) - self._centre
            length = np.linalg.norm(source, axis=-1, keepdims=True)
            every = np.concatenate([length, source / length @ self._axes.T], axis=-1)
            for strength, row in zip(amplitude * traced.exists.reshape(shape), every, strict=True):
                yield distinct(row, strength)


def distinct(theta: FloatArray, strength: FloatArray) -> FloatArray:
    """The strongest different paths [k, p] among some with strengths [m], 0 for place holders."""
    order = np.argsort(-strength, kind="stable")
    least = FAINT * np.sqrt(np.square(strength).sum())
    chosen: list[int] = []
    for place in order[strength[order] > least]:
        # Nearly equal paths would share a gain, which an uplink cannot divide between them.
        apart = np.abs(theta[chosen] - theta[place])
        if not ((apart[:, 0] < ALIKE_M) & (apart[:, 1:] < ALIKE_COSINE).all(axis=1)).any():
            chosen.append(int(place))
        if len(chosen) == MOST:
            break
    return theta[chosen]


Kind = Literal["auto", "spherical", "plane", "free"]
BOTH_GAPS = (1, 2)  # spacings between the last uplink and the first downlink subcarrier, where frequencies are unknown


@dataclass(frozen=True)
class PathSettings(SpecularOptions, CheckedSettings):
    """Settings of the search for paths."""

    #: ``spherical``, ``plane``, ``free`` (a gain for each antenna) or ``auto``, chosen on validation rows
    wavefront: Kind = "auto"
    max_paths: Count = 100  #: most paths of a row
    max_distance_m: Positive = 100.0  #: longest path, metres
    between: int = 1  #: steps of refinement of all paths after each addition
    final: int = 15  #: steps of refinement after the last addition
    #: distance of subcarriers where the data have no frequencies; that of 802.11 at 20 MHz
    spacing_hz: Positive = 312.5e3
    choice_rows: Count = 16  #: validation rows that choose the wave model
    depth: Count = 5
    reflections: int = 3
    rays: int = 1 << 17


def _wave_models(record: Record, settings: PathSettings, has_elements: bool, directions: bool) -> list[str]:
    """Wave models among which `choose` chooses (InputError: the stated one needs elements that are unknown)."""
    if directions and (not has_elements or settings.wavefront == "free"):
        text = "paths of a scene need the array's elements, the frequencies, and another wavefront than free"
        raise InputError(f"{record.name}: {text}; give them or omit the scene")
    if not has_elements and settings.wavefront in ("spherical", "plane"):
        text = "waves need the array's elements and the frequencies; give both or choose wavefront=free"
        raise InputError(f"{record.name}: {settings.wavefront} {text}")
    if not has_elements:
        return ["free"]
    every = ["spherical", "plane", *(["free"] * (not directions))]
    return every if settings.wavefront == "auto" else [settings.wavefront]


def _options(record: Record, settings: PathSettings, directions: bool) -> list[tuple[str, Bands]]:
    """Wave models and bands among which `choose` chooses; errors as there."""
    first = bands_of(record, settings.spacing_hz)
    kinds = _wave_models(record, settings, first.elements_m is not None, directions)
    candidates = [first] if first.known else [bands_of(record, settings.spacing_hz, gap) for gap in BOTH_GAPS]
    return [(kind, bands) for bands in candidates for kind in kinds]


def choose(
    rows: tuple[IntArray, IntArray],
    record: Record,
    settings: PathSettings,
    on_progress: OnProgress,
    directions: bool = False,
) -> tuple[str, Bands]:
    """The wave model and the bands whose extrapolation fits the downlink of validation rows best in the median.

    Of ``rows`` that train and that validate, the latter decide where there are any. ``directions``: among the wave
    models whose paths have a direction.

    Raises:
        InputError: as `bands_of`, or a wave front that needs elements where there are none.
    """
    train, validation = rows
    options = _options(record, settings, directions)
    if len(options) == 1:  # nothing to choose, and no row needs a downlink
        return options[0]
    judges = validation if len(validation) else train
    judges = judges[np.linspace(0, len(judges) - 1, min(settings.choice_rows, len(judges))).round().astype(int)]
    assert record.uplink is not None
    uplink, truth = record.uplink[judges].astype(complex), record.observation[0, judges]
    errors = []
    for number, (kind, bands) in enumerate(options):
        on_progress(f"choosing a wave model: {kind}", number / len(options))
        waves = waves_of(kind, bands, settings.max_distance_m)
        paths = find_paths(waves, uplink, settings.max_paths, settings.between, settings.final)
        predicted = waves.evaluate(paths.theta, paths.gains, bands.downlink_hz)
        errors.append(float(np.median(relative_error(predicted, truth))))
    return options[int(np.argmin(errors))]


@dataclass(eq=False)
class R2F2(Fitted):
    """Downlink from paths of the uplink, with the chosen wave model ``kind`` and bands, and the paths of a scene."""

    problem: Problem = field(metadata=NOT_STORED)
    kind: str
    bands: Bands
    settings: PathSettings

    def __post_init__(self) -> None:
        self.waves = waves_of(self.kind, self.bands, self.settings.max_distance_m)

    @cached_property
    def scene(self) -> ScenePaths | None:
        """Paths of the problem's scene; None without one."""
        if self.problem.scene is None:
            return None
        record = self.problem.record
        return ScenePaths(self.problem.opened_scene, record.receivers[0], record.tx_antenna, self.settings.options)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``."""
        paths = self.paths(np.asarray(inputs.uplink, complex), inputs)
        downlink = self.waves.evaluate(paths.theta, paths.gains, self.bands.downlink_hz)
        return Prediction(downlink.astype(np.complex64))

    def paths(self, h: Complex, inputs: Inputs) -> UplinkPaths:
        """Paths of uplinks [m, antennas, f] from the positions of ``inputs``."""
        s, start = self.settings, None
        if self.scene is not None:
            start = self.scene(self.waves, h, inputs.tx_pos_m, inputs.tx_heading_rad)
        return find_paths(self.waves, h, s.max_paths, s.between, s.final, start)


class R2F2Model(UplinkModel):
    """R2F2, from the paths of a scene where there is one."""

    name = "r2f2"
    settings: type = PathSettings
    fitted: type[Fitted] = R2F2
    source = "Vasisht et al., Eliminating channel feedback in next-generation cellular networks (SIGCOMM 2016)"
    summary = "paths fitted to the uplink"
    scene: Literal["none", "optional", "required"] = "optional"

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of known frequencies, of a choice without options, and of paths that are not traced."""
        s, record = problem.settings, problem.record
        self.known_rows(record, splits[0])  # refuses data that have no bands
        unused = unused_spacing(record) | without_effect(s.options)
        if problem.scene is None:
            unused |= dict.fromkeys(names_of(SpecularOptions), "no scene is traced")
        if len(_options(record, s, problem.scene is not None)) == 1:
            unused["choice_rows"] = "there is one wave model, and nothing to choose"
        return unused

    def fit(self, problem: Problem, split: Split, session: FitSession) -> R2F2:
        """Choose the wave model and, where frequencies are unknown, the bands."""
        settings, rows = problem.settings, self.known_rows(problem.record, split)
        kind, bands = choose(rows, problem.record, settings, session.progress, directions=problem.scene is not None)
        return R2F2(problem, kind, bands, settings)


MODEL = R2F2Model()
