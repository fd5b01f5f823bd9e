"""The plugin `wrf_gaussian_medium`: Gaussians as attenuation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.core import InputError
from wrf_mi.gaussians.parameters import Gaussians

from .emitter import GaussianEmitter
from .extinction_cells import largest_extinction, make_cells, to_device
from .optical_depth import attenuators, extinction, on_host, optical_depth
from .shape import deinterleave
from .source import FieldSource, source_from_properties

LEAST_MAJORANT_PER_M = 1e-6
"""Smallest majorant of free flights: Gaussians of no opacity give long ones and no division by zero."""

UNIT_TOLERANCE = 1e-5
"""Largest excess of a magnitude over one, from rounding in float32."""

_GEOMETRY = ("centers", "scales", "quaternions")
_ARRAYS: dict[str, tuple[int, Callable[[Any], Any], str]] = {
    "centers": (3, lambda a: np.isfinite(a).all(axis=1), "not finite"),
    "scales": (3, lambda a: (np.isfinite(a) & (a > 0)).all(axis=1), "not finite and positive"),
    "quaternions": (4, lambda a: np.isfinite(a).all(axis=1) & a.any(axis=1), "not finite or zero"),
    "opacity": (1, lambda a: ((a >= 0) & (a <= 1)).all(axis=1), "not within 0 and 1"),
    "attenuation": (2, lambda a: np.linalg.norm(a, axis=1) <= 1 + UNIT_TOLERANCE, "of a magnitude above 1"),
}
"""Numbers per Gaussian of each array, test of its rows and the message on failure."""


class GaussianMedium(mi.Medium):
    """Gaussians as an absorbing heterogeneous medium, for `volpath` and for transmittance in closed form.

    The Gaussians come from a `wrf_gaussian_emitter`, from a run folder, or from arrays:

    ================= ============= ==== ========== ===============================================================
    parameter         type          unit default    meaning (differentiable, but for ``run``)
    ================= ============= ==== ========== ===============================================================
    (nested plugin)   emitter            one of 3   a ``wrf_gaussian_emitter`` or a reference, whose changes it follows
    ``run``,          string, point , m  one of 3   as for ``wrf_gaussian_emitter``, weights included
    ``tx_position``
    ``centers``       tensor [n, 3] m    one of 3 * Gaussians as in Mitsuba's ``ellipsoids``
    ``scales``        tensor [n, 3] m    *          standard deviations along its axes
    ``quaternions``   tensor [n, 4]      *          axes to world, order x, y, z, w
    ``opacity``       tensor [n]         one of 2   alpha at the centre, 0 to 1
    ``attenuation``   tensor [n, 2]      one of 2   complex delta (re, im); only its magnitude has an effect
    ``scale``         float              1          factor on the optical depth: 1 for amplitudes, 2 for powers
    ================= ============= ==== ========== ===============================================================

    (*) with discontinuities: the edge at three standard deviations.

    The stencil may be any closed shape around the Gaussians, of any size. A sensor inside needs the medium as well.
    Opacity becomes extinction so that 1 - alpha = exp(-optical depth) along every line through the centre, see
    `wrf_mi_plugins.optical_depth`; for that the extinction depends on the ray's direction. Nothing is scattered.

    Free flights are drawn from one bound for the whole medium; for costs see `docs/plugins.md`. Mitsuba's
    ``volpathmis`` does not work in polarised variants.
    """

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.m_is_homogeneous = False
        self.m_has_spectral_extinction = False
        self.m_sample_emitters = props.get("sample_emitters", False)  # nothing is scattered
        self.scale = mi.Float(props.get("scale", 1.0))
        self.emitter, self.source, self.arrays = _gaussians_given(props)
        if self.emitter is not None:
            self.emitter.add_medium(self)
        self.gaussians_changed()

    def _gaussians(self) -> Gaussians:
        if self.emitter is not None:
            return self.emitter.gaussians
        if self.source is not None:
            return self.source.gaussians()
        return _from_arrays(self.arrays)

    def gaussians_changed(self) -> None:
        """Compute extinction, grid and bound."""
        self._attenuators = attenuators(self._gaussians())
        self._attenuators.depth = self._attenuators.depth * self.scale
        host = on_host(self._attenuators)
        cells = make_cells(host)
        self.majorant_per_m = max(largest_extinction(host, cells), LEAST_MAJORANT_PER_M)
        self._majorant = dr.opaque(mi.Float, self.majorant_per_m)
        self._cells = to_device(cells, mi.Float)
        low, high = host.bounds_m()
        self._box = mi.BoundingBox3f(*(mi.Point3f([dr.opaque(mi.Float, x) for x in p.tolist()]) for p in (low, high)))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the scale and, unless an emitter has them, the parameters of the Gaussians."""
        super().traverse(callback)
        callback.put("scale", self.scale, mi.ParamFlags.Differentiable)
        if self.source is not None:
            self.source.traverse(callback)
        for name, values in self.arrays.items():
            flags = mi.ParamFlags.Discontinuous if name in _GEOMETRY else mi.ParamFlags.Differentiable
            callback.put(name, values, flags)

    def parameters_changed(self, keys: Any = ()) -> None:
        """Update extinction, grid and bound."""
        super().parameters_changed(keys)
        self.gaussians_changed()

    def optical_depth(self, ray: mi.Ray3f) -> mi.Float:
        """Optical depth along rays from their origin to their ``maxt``, in closed form; differentiable.

        The logarithm of the transmittance is minus this.
        """
        return optical_depth(self._attenuators, list(ray.o), list(ray.d), mi.Float(0), mi.Float(ray.maxt))

    def extinction(self, position: mi.Point3f, direction: mi.Vector3f, active: Any = True) -> mi.Float:
        """Extinction at points for rays through them in unit ``direction``, 1/m; differentiable."""
        return extinction(self._attenuators, self._cells, list(position), list(direction), mi.Bool(active))

    def intersect_aabb(self, ray: mi.Ray3f) -> Any:
        """Entry and exit of rays at the box around all cut-off ellipsoids."""
        return self._box.ray_intersect(ray)

    def get_majorant(self, mei: mi.MediumInteraction3f, active: Any = True) -> mi.UnpolarizedSpectrum:
        """Upper bound of the extinction, constant in space."""
        return mi.UnpolarizedSpectrum(self._majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: Any = True
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """Scattering (none), null and total coefficient."""
        total = self.extinction(mei.p, mei.wi, active)
        return mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(self._majorant - total), mi.UnpolarizedSpectrum(total)

    def to_string(self) -> str:
        """Number of Gaussians and the bound."""
        count = dr.width(self._attenuators.depth)
        return f"GaussianMedium[{count} Gaussians, extinction below {self.majorant_per_m:g} per m]"


def _gaussians_given(props: Any) -> tuple[GaussianEmitter | None, FieldSource | None, dict[str, Any]]:
    """The given one of emitter, run folder and arrays.

    Raises:
        InputError: none or several, or arrays that do not fit together.
    """
    nested = [props[key] for key in props if isinstance(props[key], GaussianEmitter)]
    arrays = {key: mi.TensorXf(props[key]) for key in _ARRAYS if key in props}
    ways = len(nested) + ("run" in props) + bool(arrays)
    if ways != 1:
        raise InputError(f"wrf_gaussian_medium: {ways} sources; give one emitter, or run and tx_position, or arrays")
    if nested:
        return nested[0], None, {}
    if not arrays:
        return None, source_from_properties(props), {}
    if not set(_GEOMETRY) <= set(arrays) or ("opacity" in arrays) == ("attenuation" in arrays):
        wanted = "centers, scales, quaternions and one of opacity and attenuation"
        raise InputError(f"wrf_gaussian_medium: arrays {', '.join(arrays)}; give {wanted}")
    count = arrays["centers"].shape[0]
    for key, values in arrays.items():
        width, valid, fault = _ARRAYS[key]
        if dr.width(values) != count * width or count == 0:
            shape, wanted_shape = list(values.shape), [count, width]
            raise InputError(f"wrf_gaussian_medium: {key} has shape {shape}; with these centers give {wanted_shape}")
        bad = np.flatnonzero(~valid(values.numpy().reshape(count, -1)))
        if len(bad):
            raise InputError(f"wrf_gaussian_medium: {key}, row {bad[0]} (from 0), is {fault}; correct or remove it")
    return None, None, arrays


def _from_arrays(arrays: dict[str, Any]) -> Gaussians:
    count = arrays["centers"].shape[0]
    columns: dict[str, Any] = {name: deinterleave(values.array, count) for name, values in arrays.items()}
    zero = dr.zeros(mi.Float, count)
    centers, scales, quaternions = (columns[name] for name in _GEOMETRY)
    return Gaussians(
        centers,
        scales,
        quaternions,
        signal=[zero, zero],
        opacity=columns["opacity"][0] if "opacity" in arrays else None,
        attenuation=columns.get("attenuation"),
        batch=1,
    )


def register() -> None:
    """Make `wrf_gaussian_medium` known to Mitsuba."""
    mi.register_medium("wrf_gaussian_medium", GaussianMedium)
