"""The traced side of a physics model: Sionna RT's paths, whose gains, lengths and directions follow parameters.

Which surfaces a wave meets is searched for by `wrf_mi.tracing` and has no derivative; it is kept. What has one, the
image method and the field along each path, is evaluated anew in each call (`wrf_mi.tracing.field_calculator`) with the
present
parameters: materials, the scene's planes, the instrument's gain, antenna patterns and the receiver's pose.

All of it is float64 over planes in float64, so that phases k d are exact to 1e-12 rad for the scene as its file states
it; the file's float32 corners, 5e-7 m at 10 m, are what the real walls are known to at best.

Paths appear and vanish as a receiver moves, without a derivative. The rule: the set of paths stays as it is until the
receiver is further than ``search_again_m`` (a quarter of a wavelength) from where they were searched for;
`TracedField.refresh` then searches again. Planes that move keep their paths (`wrf_mi.tracing.plane_parameters` says
why).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..backend.device import on_device
from ..core import Antenna, InputError, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..core.types import IntArray
from ..gaussians.footprint import Pose
from . import TraceOptions, TraceResult, trace_paths
from .buffer import SPECULAR, TRANSMISSION
from .field_calculator import Chains, Complex, Level, Tables, Vector, evaluate_paths
from .material_parameters import Materials, SlabMaterials, slabs_of_faces
from .pattern_parameters import pattern_coefficients, pattern_factor
from .plane_parameters import PlaneTables
from .pose import component, moved_m, pose_parameters, receiver_pose
from .solve import Prepared
from .surfaces import Surfaces, scene_surfaces

Float64: Any = dr.float64_array_t(mi.Float)
TX_PATTERN = "pattern.transmitter"


@dataclass(frozen=True)
class TracedOptions:
    """What the traced side is.

    Attributes:
        trace: what is searched for; without diffraction and scattering, whose fields have no derivative here: what
            they would add is left to the learned side.
        pattern_degree: of the trainable factors of both antennas' patterns, 0 for none (see
            `wrf_mi.tracing.pattern_parameters`).
        gain: amplitude by which every path is multiplied at first: from the channel's units to the instrument's.
        tx_antenna: antenna of the transmitters, turned with their heading; the receiver states its own.
        materials: whether each named material has a permittivity and a conductivity of its own, or each surface, the
            faces of one object in one plane, started from its named material.
        planes: list shifts and tilts of the scene's planes among the parameters (`wrf_mi.tracing.plane_parameters`).
        faint: paths of a transmitter are left out, weakest first, while their amplitudes add up to less than this share
            of the amplitudes of all, with the scene's materials; 0: none are.
        search_again_m: how far the receiver may move before paths are searched again; None: a quarter of a wavelength.
    """

    trace: TraceOptions = field(default_factory=TraceOptions)
    pattern_degree: int = 0
    gain: float = 1.0
    search_again_m: float | None = None
    tx_antenna: Antenna = ANTENNA
    materials: Materials = "named"
    planes: bool = False
    faint: float = 0.0

    def __post_init__(self) -> None:
        """Reject what cannot be followed.

        Raises:
            InputError: diffraction or scattering asked for.
        """
        if self.trace.diffraction or self.trace.scattering:
            raise InputError("traced side: diffraction and scattering have no derivative here; switch both off")


@dataclass
class TracedPaths:
    """Paths to one receiver as Dr.Jit arrays with derivatives: ``each`` for every transmitter of the batch.

    Arrays [batch * each], float64, the transmitter's number slowest; a path of gain zero fills the place of one that
    is not there.

    Attributes:
        gain: complex (re, im): free-space loss, interactions, antennas, instrument; without the phase exp(-j k length).
        length_m: unfolded length, metres.
        arrival: unit vector towards where the wave comes from, receiver's frame.
        batch: number of transmitters.
        each: paths of each.
    """

    gain: Complex
    length_m: Any
    arrival: Vector
    batch: int
    each: int


class TracedField:
    """The traced field of some transmitters at one receiver.

    Args:
        scene: from `wrf_mi.tracing.open_scene`. It is read and never changed.
        tx_pos_m: transmitters [n, 3], world frame, metres.
        receiver: stated pose.
        options: see `TracedOptions`.
        tx_heading_rad: yaw of each transmitter's own frame about +z, shape [n]; None: 0.
        traced: paths found before, from the same transmitters to the same receiver; None: they are searched now.
        prepared: of the scene, where many fields are traced in it: rays of a receiver are then shot once, and who made
            it checks the antennas (`wrf_mi.tracing.solve.Prepared.check`).

    Raises:
        ValueError: positions or headings of another shape or not finite.
        InputError: paths of other devices, or through a material that is no slab.
    """

    def __init__(
        self,
        scene: Any,
        tx_pos_m: ArrayLike,
        receiver: Receiver,
        options: TracedOptions = TracedOptions(),
        tx_heading_rad: ArrayLike | None = None,
        traced: TraceResult | None = None,
        prepared: Prepared | None = None,
    ) -> None:
        self.tx_pos_m: FloatArray = np.atleast_2d(np.asarray(tx_pos_m, float))
        if self.tx_pos_m.ndim != 2 or self.tx_pos_m.shape[1] != 3 or not np.isfinite(self.tx_pos_m).all():
            raise ValueError(f"TracedField: tx_pos_m has shape {np.shape(tx_pos_m)}; give finite [n, 3]")
        heading = np.zeros(len(self.tx_pos_m)) if tx_heading_rad is None else np.asarray(tx_heading_rad, float)
        if heading.shape != (len(self.tx_pos_m),) or not np.isfinite(heading).all():
            raise ValueError(f"TracedField: tx_heading_rad has shape {heading.shape}; give finite [n]")
        if traced is not None and not _same_devices(traced, self.tx_pos_m, receiver):
            n, m = len(traced.tx_pos_m), len(traced.receivers)
            text = f"paths of {n} transmitters to {m} receivers, not of these {len(self.tx_pos_m)} to {receiver.name}"
            raise InputError(f"{text}; trace these")
        self.scene, self.receiver, self.options, self.heading_rad = scene, receiver, options, heading
        self._prepared = prepared
        self.frequency_hz = float(scene.frequency[0])
        self.searches = 0
        quarter_m = speed_of_light / self.frequency_hz / 4
        self._again_m = quarter_m if options.search_again_m is None else options.search_again_m
        self._surfaces: Surfaces = scene_surfaces(scene)
        self._materials, self._slab_of_face = slabs_of_faces(scene, self._surfaces, options.materials)
        self._constants = self._materials.constants(Float64)
        self._planes = PlaneTables.of(self._surfaces)
        if traced is None:
            self.search(receiver.position_m)
        else:
            self._take(traced, receiver.position_m)

    def __len__(self) -> int:
        """Number of transmitters."""
        return len(self.tx_pos_m)

    @property
    def exists(self) -> NDArray[np.bool_]:
        """Which places of `TracedPaths` hold a path, for all transmitters."""
        return self._chains.exists.numpy() > 0

    @property
    def arrays(self) -> list[Any]:
        """What a call reads on the device beside its arguments: a recording takes it as inputs."""
        return [self._chains, self._constants, self._planes]

    @property
    def chains(self) -> Chains:
        """What each path meets, planes as stated."""
        return self._chains

    @property
    def slabs(self) -> SlabMaterials:
        """The scene's materials as stated, or those of its surfaces in the order of their parameters."""
        return self._materials

    @property
    def surfaces(self) -> Surfaces:
        """The scene's surfaces, whose planes those of the parameters are."""
        return self._surfaces

    @property
    def gain_name(self) -> str:
        """Parameter [2]: logarithm of the instrument's amplitude, and its phase in rad."""
        return f"receiver.{self.receiver.name}.gain"

    @property
    def pattern_name(self) -> str:
        """Parameter [2, c]: factor of the receiver's pattern, see `wrf_mi.tracing.pattern_parameters`."""
        return f"receiver.{self.receiver.name}.pattern"

    def parameters(self) -> dict[str, NDArray[np.float32]]:
        """Starting values by name: the scene's materials, the stated pose, antenna patterns of factor one.

        ``material.<name>.permittivity`` and ``.conductivity`` [1] (see `wrf_mi.tracing.material_parameters`), or of n
        surfaces ``material.surface.permittivity`` and ``.conductivity`` [n]; with planes ``plane.shift`` [q] in m and
        ``plane.tilt`` [q, 2] in rad (see `wrf_mi.tracing.plane_parameters`);
        ``receiver.<name>.gain`` [2], ``.position`` [3] in m, ``.turn`` [3] in rad; with a degree of patterns,
        ``receiver.<name>.pattern`` and ``pattern.transmitter`` [2, c].
        """
        values = self._materials.parameters() | pose_parameters(self.receiver)
        values[self.gain_name] = np.array([np.log(self.options.gain), 0], np.float32)
        if self.options.pattern_degree:
            names = self.pattern_name, TX_PATTERN
            values |= {name: pattern_coefficients(self.options.pattern_degree) for name in names}
        if self.options.planes:
            values |= self._planes.parameters()
        return values

    def refresh(self, parameters: Mapping[str, Any]) -> bool:
        """Search for paths again if the receiver has moved too far from where they were searched.

        Returns:
            Whether it did.
        """
        here = moved_m(self.receiver, parameters)
        if np.linalg.norm(here - self.searched_at_m) <= self._again_m:
            return False
        self.search(here)
        return True

    def __call__(self, parameters: Mapping[str, Any], rows: Any | None = None) -> TracedPaths:
        """Paths of some transmitters with the given parameters. Differentiable in all of them.

        Args:
            parameters: Dr.Jit tensors by the names of `parameters`; what is missing stays as it was at first.
            rows: transmitters of the batch, an unsigned integer array; None: all.
        """
        chains, batch = self._chains, len(self)
        if rows is not None:
            batch = dr.width(rows)
            slot = dr.arange(mi.UInt32, batch * self._each)
            row = dr.gather(mi.UInt32, rows, slot // self._each)
            chains = chains.select(row * self._each + slot % self._each)
        chains = replace(chains, levels=self._planes.move(chains.levels, parameters))
        stated, fixed = self._constants[:2], self._constants[2:]
        tables = Tables(*self._materials.tables(parameters, stated), *fixed)
        pose = _spread(receiver_pose(self.receiver, parameters, Float64), batch * self._each)
        antennas = self.receiver.antenna, self.options.tx_antenna
        followed = evaluate_paths(chains, pose, tables, self.frequency_hz, *antennas)
        # Evaluated here, the kernels of the reverse pass read it instead of computing it each.
        dr.eval(followed)
        amplitude, phase = Float64(np.log(self.options.gain)), Float64(0)
        if self.gain_name in parameters:
            amplitude, phase = (Float64(component(parameters[self.gain_name], i)) for i in (0, 1))
        sine, cosine = dr.sincos(phase)
        gain = _times(followed.gain, (dr.exp(amplitude) * cosine, dr.exp(amplitude) * sine))
        for name, direction in ((self.pattern_name, followed.arrival), (TX_PATTERN, followed.departure)):
            if name in parameters:
                gain = _times(gain, pattern_factor(parameters[name], direction))
        return TracedPaths(gain, followed.length_m, followed.arrival, batch, self._each)

    def pose(self, parameters: Mapping[str, Any], float_type: Any = mi.Float) -> Pose:
        """The receiver's corrected pose, for the learned side."""
        return receiver_pose(self.receiver, parameters, float_type)

    def search(self, here_m: FloatArray) -> None:
        """Search for paths anew, the receiver at a position [3], world frame, metres."""
        receiver = replace(self.receiver, position_m=here_m)
        how: dict[str, Any] = {"tx_antenna": self.options.tx_antenna, "check": self._prepared is None}
        found = trace_paths(self.scene, self.tx_pos_m, receiver, self.options.trace, prepared=self._prepared, **how)
        self._take(found, here_m)
        self.searches += 1

    def _take(self, traced: TraceResult, here_m: FloatArray) -> None:
        """Lay paths out with as many places for each transmitter as the richest one needs."""
        if self.options.faint:
            traced = traced.without_faint(self.options.faint)
        surfaces, types = self._surfaces, traced.paths.interactions
        face = np.full(types.shape, -1)
        if types.any():
            legs = traced.legs(surfaces)
            face = (legs.reverse() if traced.from_receivers else legs).face  # from the transmitter
        if not np.isin(types, (0, SPECULAR, TRANSMISSION)).all():
            raise InputError("paths with diffraction or scattering have no derivative here; trace without them")
        tx, used = traced.paths.tx, types != 0
        material = self._slab(face, used)
        each = max(1, int(np.bincount(tx, minlength=1).max(initial=0)))
        place = tx * each + np.arange(len(tx)) - np.searchsorted(tx, tx)
        count = len(self) * each

        def laid_out(values: ArrayLike, kind: Any) -> Any:
            given = np.asarray(values)
            array = np.zeros(count, given.dtype)
            array[place] = given
            return on_device(array, kind)

        def whole(values: FloatArray) -> Any:
            return on_device(np.repeat(values, each), Float64)

        levels = []
        for k in range(types.shape[1] if used.any() else 0):
            plane = np.where(used[:, k], surfaces.plane[np.where(used[:, k], face[:, k], 0)], 0)
            normal = surfaces.normal[plane] * used[:, k, None]
            levels.append(
                Level(
                    [laid_out(c, Float64) for c in normal.T],
                    laid_out(surfaces.offset[plane] * used[:, k], Float64),
                    laid_out(types[:, k] == SPECULAR, mi.Bool),
                    laid_out(types[:, k] == TRANSMISSION, mi.Bool),
                    laid_out(material[:, k].astype(np.uint32), mi.UInt32),
                    laid_out(plane.astype(np.uint32), mi.UInt32),
                )
            )
        self._each, self.searched_at_m = each, np.array(here_m, float)
        self._chains = Chains(
            [whole(c) for c in self.tx_pos_m.T],
            (whole(np.cos(self.heading_rad)), whole(np.sin(self.heading_rad))),
            laid_out(np.ones(len(tx)), Float64),
            levels,
        )

    def _slab(self, face: IntArray, used: NDArray[np.bool_]) -> IntArray:
        """Number of the material at each interaction, 0 where there is none."""
        if not used.any():
            return np.zeros(face.shape, np.int64)
        number = np.where(used, self._slab_of_face[np.where(used, face, 0)], 0)
        if (number < 0).any():
            index = self._surfaces.object_of(face[number < 0][:1])[0]
            what = self._surfaces.names[index]
            kind = self.scene.objects[what].radio_material.name
            raise InputError(f"object {what}: material {kind} is not a slab; give it one of ITU-R P.2040")
        return number


def _same_devices(traced: TraceResult, tx_pos_m: FloatArray, receiver: Receiver) -> bool:
    return (
        np.array_equal(traced.tx_pos_m, tx_pos_m)
        and len(traced.receivers) == 1
        and np.array_equal(traced.receivers[0].position_m, receiver.position_m)
    )


def _spread(pose: Pose, count: int) -> Pose:
    """A pose as arrays of ``count`` values.

    The derivative of a gather is a sum in the same kernel; that of a broadcast number would be a kernel for each of the
    twelve, and each would compute all that comes before it.
    """
    table = dr.concat([*pose.position, *(c for row in pose.to_world for c in row)])
    wide = [dr.gather(Float64, table, dr.full(mi.UInt32, i, count)) for i in range(12)]
    return Pose(wide[:3], [wide[3:6], wide[6:9], wide[9:12]])


def _times(a: Complex, b: Complex) -> Complex:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]
