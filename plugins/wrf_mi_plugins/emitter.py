"""The plugins `wrf_gaussian_emitter`, Gaussians as virtual transmitters, and `wrf_gaussians`, the shape they fill."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
from numpy.typing import ArrayLike

from wrf_mi.core import InputError
from wrf_mi.gaussians.footprint import CUTOFF
from wrf_mi.gaussians.parameters import Gaussians

from .optical_depth import attenuators, closest_approach
from .shape import gaussian_shape, shape_parameters
from .source import FieldSource, source_from_properties, source_of


class GaussianEmitter(mi.Emitter):
    """Gaussians as virtual transmitters whose complex signals depend on the position of the real transmitter.

    The emitter holds a trained field and a transmitter position. It is an area emitter of one shape `wrf_gaussians`,
    whose geometry and attributes ``signal``, ``opacity`` or ``attenuation`` it writes when the shape is loaded and
    after each change of the emitter's parameters. The traced integrator reads the complex signals there.
    Declare the emitter in the scene and refer to it in the shape, so that ``mi.traverse(scene)`` lists its parameters.

    =============== ====== ==== ======== =========================================================================
    parameter       type   unit default  meaning
    =============== ====== ==== ======== =========================================================================
    ``run``         string      required run folder made by ``wrf-mi train`` (or its ``model.npz``)
    ``tx_position`` point  m    required position of the transmitter, world frame; differentiable
    (weights)       tensor      from run parameters of the field by name, dots as underscores; differentiable
    =============== ====== ==== ======== =========================================================================

    The parameters ``position``, ``log_scale`` and ``rotation`` have discontinuities at the edges of footprints.

    Stock integrators carry power, not phase. For them each Gaussian radiates |a S|^2 along each ray, with its signal S
    and a = opacity times G under alpha blending, a = G under product blending, where G is its largest value along the
    ray. In a shape with a ``null`` BSDF, the default, these powers add up along a ray. Only rays that hit a Gaussian
    find it: the emitter cannot be sampled and returns a density of zero.
    """

    def __init__(self, props: mi.Properties, source: FieldSource | None = None) -> None:
        super().__init__(props)
        self.m_flags = mi.EmitterFlags.Surface | mi.EmitterFlags.SpatiallyVarying
        self.source = source_from_properties(props) if source is None else source
        self._media: list[weakref.ref[Any]] = []
        self._refresh()

    def _refresh(self) -> None:
        self.gaussians: Gaussians = self.source.gaussians()
        self._attenuators = attenuators(self.gaussians)

    def add_medium(self, medium: Any) -> None:
        """Call ``medium.gaussians_changed()`` after each change of the Gaussians."""
        self._media.append(weakref.ref(medium))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the transmitter position and the field's parameters."""
        super().traverse(callback)
        self.source.traverse(callback)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Evaluate the field and update the shape and media."""
        super().parameters_changed(keys)
        if list(keys) == ["parent"]:  # a change of the shape that this emitter made
            return
        self._refresh()
        shape = self.get_shape()
        if shape is not None:
            parameters = mi.traverse(shape)
            for name, values in shape_parameters(self.gaussians).items():
                # Unchanged geometry is not traced anew.
                old = parameters[name]
                unchanged = dr.width(values) == dr.width(old) and not dr.grad_enabled((values, old))
                if not (unchanged and dr.all(values == old)):
                    parameters[name] = values
            parameters.update()
        for reference in self._media:
            medium = reference()
            if medium is not None:
                medium.gaussians_changed()

    def eval(self, si: mi.SurfaceInteraction3f, active: Any = True) -> mi.Spectrum:
        """Power |a S|^2 of the Gaussian hit along the ray, unpolarised."""
        g, index = self.gaussians, si.prim_index
        direction = si.to_world(si.wi)
        square, _, _ = closest_approach(self._attenuators.at(index), list(si.p), list(direction))
        amplitude = dr.select(active & (square < CUTOFF * CUTOFF), dr.exp(-0.5 * square), 0)
        if g.opacity is not None:
            amplitude *= dr.gather(mi.Float, g.opacity, index)
        re, im = (dr.gather(mi.Float, part, index) * amplitude for part in g.signal)
        radiance: Any = mi.UnpolarizedSpectrum(re * re + im * im)
        return mi.depolarizer(radiance)

    def sample_direction(
        self, it: mi.Interaction3f, sample: mi.Point2f, active: Any = True
    ) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
        """No sample: density zero, so rays that hit the Gaussians count in full."""
        return dr.zeros(mi.DirectionSample3f), mi.Spectrum(0)

    def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Any = True) -> Any:
        """Density of `sample_direction`: zero."""
        return mi.Float(0)

    def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Any = True) -> mi.Spectrum:
        """Radiance of a direction sample, of which there are none."""
        return mi.Spectrum(0)

    def bbox(self) -> mi.ScalarBoundingBox3f:
        """Bounding box of the shape."""
        shape = self.get_shape()
        return mi.ScalarBoundingBox3f() if shape is None else shape.bbox()

    def to_string(self) -> str:
        """Model, number of Gaussians and transmitter."""
        position: Any = dr.ravel(dr.detach(self.source.tx_position))
        where = ", ".join(f"{x:g}" for x in position)
        model = type(self.source.field).__name__
        return f"GaussianEmitter[{model}, {self.gaussians.count} Gaussians, transmitter at ({where}) m]"


def gaussian_emitter(
    field: Any, params: Mapping[str, ArrayLike], tx_position_m: ArrayLike, name: str = "transmitter"
) -> GaussianEmitter:
    """An emitter from a user-defined model, or from parameters without a run folder; an entry for ``mi.load_dict``.

    Args:
        field: any object with the method ``gaussians`` of `wrf_mi.gaussians.WrfGsPlus`.
        params: parameters of the field by name.
        tx_position_m: transmitter position [3], world frame, metres.
        name: name under which ``mi.traverse`` lists the emitter's parameters; use it as the key in dictionaries, too.

    Raises:
        InputError: a position of another shape or not finite.
    """
    emitter = GaussianEmitter(mi.Properties("wrf_gaussian_emitter"), source_of(field, params, tx_position_m))
    emitter.set_id(name)
    return emitter


def _shape_of_emitter(props: mi.Properties) -> mi.Shape:
    """The plugin `wrf_gaussians`: the built-in ``ellipsoids`` shape with the Gaussians of the emitter given to it."""
    members = {key: props[key] for key in props if isinstance(props[key], mi.Object)}
    emitters = [value for value in members.values() if isinstance(value, GaussianEmitter)]
    if len(emitters) != 1:
        raise InputError(f"wrf_gaussians: {len(emitters)} wrf_gaussian_emitter in it; give one, or a reference to one")
    (emitter,) = emitters
    entry = gaussian_shape(emitter.gaussians) | {"id": props.id(), emitter.id() or "emitter": emitter}
    others = {key: value for key, value in members.items() if value is not emitter}
    if not any(isinstance(value, mi.BSDF) for value in others.values()):
        entry["bsdf"] = {"type": "null"}
    # Mitsuba may be loading a scene in parallel, and parallel tasks do not nest.
    return mi.load_dict(entry | others, parallel=False)


def register() -> None:
    """Make `wrf_gaussian_emitter` and `wrf_gaussians` known to Mitsuba."""
    mi.register_emitter("wrf_gaussian_emitter", GaussianEmitter)
    mi.register_shape("wrf_gaussians", _shape_of_emitter)
