"""What must not change, or must change in a known way, whatever the field."""

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from traced_fields import RECEIVER, any_field
from wrf_mi_plugins.optical_depth import attenuators, optical_depth

from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Receiver
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.receivers.array import array_response, bartlett_spectrum
from wrf_mi.training.step import device_pose

ROUNDING = 1e-9
"""Float64 through some tens of operations; pixels on the edge of a footprint may fall to either side."""
SIZE = (20, 40)
BLENDINGS = ("alpha", "product")
Field = dict[str, np.ndarray]
FIELDS = st.builds(lambda seed, count: any_field(count, seed), st.integers(0, 10**6), st.sampled_from([2, 8, 40]))
FEW = settings(max_examples=2, deadline=None)
"""Of both ways of blending; each example compiles kernels."""


def gaussians_of(field: Field, blending: str) -> Gaussians:
    """In float64."""
    parts = {k: [Float64(np.ascontiguousarray(c)) for c in v.T] for k, v in field.items()}
    geometry = {name: parts[name] for name in ("position", "scale", "rotation", "signal")}
    alpha = blending == "alpha"
    opacity, attenuation = (parts["opacity"][0], None) if alpha else (None, parts["attenuation"])
    return Gaussians(**geometry, opacity=opacity, attenuation=attenuation, batch=1)


def render(field: Field, blending: str, receiver: Receiver = RECEIVER) -> np.ndarray:
    """In float64, [height, width]."""
    gaussians = gaussians_of(field, blending)
    re, im = splat(gaussians, device_pose(receiver, Float64), perception_plane(*SIZE, Float64))
    return (re.numpy() + 1j * im.numpy()).reshape(SIZE)


def alike(one: np.ndarray, other: np.ndarray) -> None:
    """Equal but for pixels on edges."""
    scale = max(np.abs(one).max(), 1e-3)
    assert (np.abs(one - other) > ROUNDING * scale).mean() < 0.01


def turned(receiver: Receiver, by: Rotation, origin: np.ndarray) -> Receiver:
    own = by * Rotation.from_quat(receiver.orientation_xyzw)
    return replace(receiver, position_m=origin + by.apply(receiver.position_m), orientation_xyzw=own.as_quat())


@FEW
@given(FIELDS, st.integers(0, 10**6))
def test_splat_is_invariant_to_rigid_motion_of_the_world(field: Field, seed: int) -> None:
    by, origin = Rotation.random(rng=np.random.default_rng(seed)), np.random.default_rng(seed).normal(size=3)
    moved = field | {
        "position": origin + by.apply(field["position"]),
        "rotation": (by * Rotation.from_quat(field["rotation"])).as_quat(),
    }
    for blending in BLENDINGS:
        alike(render(field, blending), render(moved, blending, turned(RECEIVER, by, origin)))


@FEW
@given(FIELDS, st.integers(-40, 40))
def test_rotation_of_the_receiver_about_its_normal_shifts_azimuths(field: Field, columns: int) -> None:
    spin = Rotation.from_rotvec([0, 0, 2 * np.pi * columns / SIZE[1]])
    own = Rotation.from_quat(RECEIVER.orientation_xyzw) * spin
    for blending in BLENDINGS:
        shifted = render(field, blending, replace(RECEIVER, orientation_xyzw=own.as_quat()))
        alike(np.roll(render(field, blending), -columns, axis=1), shifted)


@FEW
@given(FIELDS, st.complex_numbers(max_magnitude=1e3), st.integers(0, 10**6))
def test_images_are_linear_in_signals(field: Field, factor: complex, seed: int) -> None:
    signal = field["signal"] @ [1, 1j]
    other = np.random.default_rng(seed).normal(size=(len(signal), 2)) @ [1, 1j]
    mixed, alone = (field | {"signal": np.stack([z.real, z.imag], 1)} for z in (factor * signal + other, other))
    for blending in BLENDINGS:
        alike(render(mixed, blending), factor * render(field, blending) + render(alone, blending))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10**6), st.randoms(use_true_random=False), st.floats(0.1, 10))
def test_bartlett_spectrum_ignores_order_and_scales_with_power(seed: int, random: Any, amplitude: float) -> None:
    rng = np.random.default_rng(seed)
    elements, direction = planar_array(4, 4, 0.16), rng.normal(size=3)
    h = array_response(elements, direction / np.linalg.norm(direction), 920e6) + 0.1 * rng.normal(size=16)
    order = list(range(16))
    random.shuffle(order)
    spectrum = bartlett_spectrum(h, elements, 920e6, *SIZE)
    np.testing.assert_allclose(bartlett_spectrum(h[order], elements[order], 920e6, *SIZE), spectrum, atol=1e-9)
    scaled = bartlett_spectrum(amplitude * h, elements, 920e6, *SIZE)
    np.testing.assert_allclose(scaled**2, amplitude**2 * spectrum**2, rtol=1e-9, atol=1e-9)


@FEW
@given(FIELDS, st.floats(0.05, 0.95))
def test_optical_depth_of_coincident_gaussians_adds(field: Field, share: float) -> None:
    """Two Gaussians in one place, whose transmittances multiply to that of one."""
    opaque = np.clip(field["opacity"], 0, 0.999)
    parts = [1 - (1 - opaque) ** share, 1 - (1 - opaque) ** (1 - share)]
    twice = {name: np.concatenate([values] * 2) for name, values in field.items()}
    np.testing.assert_allclose(
        _depth(twice | {"opacity": np.concatenate(parts)}), _depth(field | {"opacity": opaque}), rtol=1e-6, atol=1e-9
    )


def _depth(field: Field) -> np.ndarray:
    """Of rays from the receiver through all Gaussians' centres."""
    own = attenuators(gaussians_of(field, "alpha"))
    away = np.unique(field["position"], axis=0) - RECEIVER.position_m
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    origin = [Float64(np.full(len(away), x)) for x in RECEIVER.position_m]
    direction = [Float64(np.ascontiguousarray(c)) for c in away.T]
    return np.asarray(optical_depth(own, origin, direction, Float64(0.0), Float64(1e3)).numpy())
