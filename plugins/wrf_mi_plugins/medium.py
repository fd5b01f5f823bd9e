"""The plugin `wrf_gaussian_medium`: Gaussians as attenuation."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.core import InputError
from wrf_mi.gaussians.extinction_cells import largest_extinction, make_cells, to_device
from wrf_mi.gaussians.optical_depth import attenuators, extinction, on_host, optical_depth
from wrf_mi.gaussians.parameters import Gaussians

from .emitter import GaussianEmitter
from .source import FieldSource, source_from_properties

LEAST_MAJORANT_PER_M = 1e-6
"""Free flights are drawn from at least this, so that Gaussians of no opacity give long ones and no division by zero."""

UNIT_TOLERANCE = 1e-5
"""By how much a magnitude of one may be above it, from rounding in float32."""

_WIDTHS = {"centers": 3, "scales": 3, "quaternions": 4, "opacity": 1, "attenuation": 2}


class GaussianMedium(mi.Medium):
    """Gaussians as an absorbing heterogeneous medium, for `volpath` and for transmittance in closed form.

    The Gaussians come from a `wrf_gaussian_emitter`, from a run folder, or from arrays:

    ================= ============== ==== ======== =============== ==================================================
    parameter         type           unit default  differentiable  meaning
    ================= ============== ==== ======== =============== ==================================================
    (nested plugin)   emitter             one of   (its own)       a ``wrf_gaussian_emitter`` or a reference to one;
                                          the                      the medium follows its changes
    ``run``,          string, point  , m  three    ``tx_position`` as for ``wrf_gaussian_emitter``; the weights are
    ``tx_position``                                and weights     exposed here, too
    ``centers``       tensor [n, 3]  m             yes *           Gaussians as in Mitsuba's ``ellipsoids``
    ``scales``        tensor [n, 3]  m             yes *           standard deviations along own axes
    ``quaternions``   tensor [n, 4]                yes *           own axes to world, order x, y, z, w
    ``opacity``       tensor [n]          one of   yes             alpha at the centre, 0 to 1
    ``attenuation``   tensor [n, 2]       the two  yes             complex delta (re, im); only its magnitude counts
    ``scale``         float               1        yes             factor on the optical depth: 1 attenuates as the
                                                                   field's amplitudes are, 2 as their powers are
    ================= ============== ==== ======== =============== ==================================================

    (*) with discontinuities: the edge at three standard deviations.

    .. code-block:: python

        "air": {"type": "wrf_gaussian_medium", "emitter": {"type": "ref", "id": "transmitter"}},
        "stencil": {"type": "sphere", "radius": 50.0, "bsdf": {"type": "null"},
                    "interior": {"type": "ref", "id": "air"}},

    The stencil may be any closed shape around the Gaussians; how much larger it is costs nothing. A sensor inside needs
    the medium as well. Opacity becomes extinction so that 1 - alpha = exp(-optical depth) along every line through the
    centre, see `wrf_mi.gaussians.optical_depth`; for that the extinction depends on the ray's direction. Nothing is
    scattered.

    Cost: free flights are drawn from one bound for the whole medium, so a ray of length L takes about bound times L
    steps; a step visits the Gaussians that reach into its cell of a grid. Bound and grid are made anew, on the host,
    when parameters change: some 0.2 s for 300 Gaussians. `optical_depth` visits every Gaussian for every ray. Mitsuba's
    ``volpathmis`` does not work in polarised variants.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_is_homogeneous = False
        self.m_has_spectral_extinction = False
        self.m_sample_emitters = props.get("sample_emitters", False)  # nothing is scattered towards them
        self.scale = mi.Float(props.get("scale", 1.0))
        self.emitter, self.source, self.arrays = _gaussians_given(props)
        if self.emitter is not None:
            self.emitter.tell(self)
        self.gaussians_changed()

    def _gaussians(self) -> Gaussians:
        if self.emitter is not None:
            return self.emitter.gaussians
        if self.source is not None:
            return self.source.gaussians()
        return _from_arrays(self.arrays)

    def gaussians_changed(self) -> None:
        """Make extinction, grid and bound anew."""
        self._of = attenuators(self._gaussians())
        self._of.depth = self._of.depth * self.scale
        host = on_host(self._of)
        cells = make_cells(host)
        self.majorant_per_m = max(largest_extinction(host, cells), LEAST_MAJORANT_PER_M)
        self._majorant = dr.opaque(mi.Float, self.majorant_per_m)
        self._cells = to_device(cells, mi.Float)
        low, high = host.bounds_m()
        self._box = mi.BoundingBox3f(*(mi.Point3f([dr.opaque(mi.Float, x) for x in p.tolist()]) for p in (low, high)))

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Expose the scale and, but for a medium that follows an emitter, what the Gaussians are made of."""
        super().traverse(callback)
        callback.put("scale", self.scale, mi.ParamFlags.Differentiable)
        if self.source is not None:
            self.source.traverse(callback)
        for name, values in self.arrays.items():
            edge = name in ("centers", "scales", "quaternions")
            callback.put(name, values, mi.ParamFlags.Discontinuous if edge else mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Make everything anew."""
        super().parameters_changed(keys)
        self.gaussians_changed()

    def optical_depth(self, ray: mi.Ray3f) -> mi.Float:
        """Optical depth along rays from their origin to their ``maxt``, in closed form; differentiable.

        The logarithm of the transmittance is minus this.
        """
        return optical_depth(self._of, list(ray.o), list(ray.d), mi.Float(0), mi.Float(ray.maxt))

    def extinction(self, position: mi.Point3f, direction: mi.Vector3f, active: Any = True) -> mi.Float:
        """Extinction at points for rays through them in unit ``direction``, 1/m; differentiable."""
        return extinction(self._of, self._cells, list(position), list(direction), mi.Bool(active))

    def intersect_aabb(self, ray: mi.Ray3f) -> tuple[mi.Bool, mi.Float, mi.Float]:
        """Where rays enter and leave the box around everything within the cut-off."""
        return self._box.ray_intersect(ray)

    def get_majorant(self, mei: mi.MediumInteraction3f, active: Any = True) -> mi.UnpolarizedSpectrum:
        """A bound of the extinction, the same everywhere."""
        return mi.UnpolarizedSpectrum(self._majorant)

    def get_scattering_coefficients(
        self, mei: mi.MediumInteraction3f, active: Any = True
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """Scattering (none), null and total coefficient."""
        total = self.extinction(mei.p, mei.wi, active)
        return mi.UnpolarizedSpectrum(0), mi.UnpolarizedSpectrum(self._majorant - total), mi.UnpolarizedSpectrum(total)

    def to_string(self) -> str:
        """One line: number of Gaussians and the bound."""
        return f"GaussianMedium[{dr.width(self._of.depth)} Gaussians, extinction below {self.majorant_per_m:g} per m]"


def _gaussians_given(props: mi.Properties) -> tuple[GaussianEmitter | None, FieldSource | None, dict[str, Any]]:
    """The one of emitter, run folder and arrays that was given.

    Raises:
        InputError: none or several, or arrays that do not fit together.
    """
    nested = [props[key] for key in props if isinstance(props[key], GaussianEmitter)]
    arrays = {key: mi.TensorXf(props[key]) for key in _WIDTHS if key in props}
    ways = len(nested) + ("run" in props) + bool(arrays)
    if ways != 1:
        raise InputError(f"wrf_gaussian_medium: {ways} sources; give one emitter, or run and tx_position, or arrays")
    if nested:
        return nested[0], None, {}
    if not arrays:
        return None, source_from_properties(props), {}
    missing = [key for key in ("centers", "scales", "quaternions") if key not in arrays]
    if missing or ("opacity" in arrays) == ("attenuation" in arrays):
        wanted = "centers, scales, quaternions and one of opacity and attenuation"
        raise InputError(f"wrf_gaussian_medium: arrays {', '.join(arrays)}; give {wanted}")
    _check_arrays(arrays)
    return None, None, arrays


def _check_arrays(arrays: dict[str, Any]) -> None:
    """Refuse arrays of other shapes, and rows that are no Gaussian.

    Raises:
        InputError: such an array.
    """
    count = arrays["centers"].shape[0]
    good = {
        "centers": (lambda a: np.isfinite(a).all(axis=1), "not finite"),
        "scales": (lambda a: (np.isfinite(a) & (a > 0)).all(axis=1), "not finite and positive"),
        "quaternions": (lambda a: np.isfinite(a).all(axis=1) & a.any(axis=1), "not finite or zero"),
        "opacity": (lambda a: ((a >= 0) & (a <= 1)).all(axis=1), "not within 0 and 1"),
        "attenuation": (lambda a: np.linalg.norm(a, axis=1) <= 1 + UNIT_TOLERANCE, "of a magnitude above 1"),
    }
    for key, values in arrays.items():
        if dr.width(values) != count * _WIDTHS[key] or count == 0:
            given, wanted = list(values.shape), [count, _WIDTHS[key]]
            raise InputError(f"wrf_gaussian_medium: {key} has shape {given}; with these centers give {wanted}")
        test, fault = good[key]
        bad = np.flatnonzero(~test(values.numpy().reshape(count, -1)))
        if len(bad):
            raise InputError(f"wrf_gaussian_medium: {key}, row {bad[0]} (from 0), is {fault}; correct or remove it")


def _from_arrays(arrays: dict[str, Any]) -> Gaussians:
    def columns(name: str) -> list[Any]:
        width = _WIDTHS[name]
        values = arrays[name].array
        index = dr.arange(mi.UInt32, dr.width(values) // width) * width
        return [dr.gather(mi.Float, values, index + k) for k in range(width)]

    centre = columns("centers")
    zero = dr.zeros(mi.Float, dr.width(centre[0]))
    return Gaussians(
        position=centre,
        scale=columns("scales"),
        rotation=columns("quaternions"),
        signal=[zero, zero],
        opacity=columns("opacity")[0] if "opacity" in arrays else None,
        attenuation=columns("attenuation") if "attenuation" in arrays else None,
        batch=1,
    )


def register() -> None:
    """Make `wrf_gaussian_medium` known to Mitsuba."""
    mi.register_medium("wrf_gaussian_medium", GaussianMedium)
