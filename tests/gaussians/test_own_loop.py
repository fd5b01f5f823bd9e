"""Training loops that a user writes over a field and `splat`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from made_spectra import OCTAVES, RECEIVERS, spectra

from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.gaussians import FIELDS, random_gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.training.step import device_pose

STEPS, FIRST = 100, 10  # steps, and those after which all kernels are there
RATE = 1e-3


def gradient_descent(field: Any) -> Iterator[list[dict[str, Any]]]:
    """Kernels of each step of a loop that replaces the parameters and never evaluates them."""
    record = spectra(rows=24)[0]
    rng = np.random.default_rng(0)
    params = {k: to_tensor(v) for k, v in field.init(random_gaussians(RECEIVERS[:1], 8, rng), rng).items()}
    pose, plane = device_pose(RECEIVERS[0]), perception_plane(*record.observation.shape[-2:], mi.Float)
    for step in range(STEPS):
        row = step % len(record)
        condition, truth = to_tensor(record.tx_pos_m[[row]].T.copy()), to_float(record.observation[0, row])
        dr.enable_grad(params)
        re, im = splat(field.gaussians(params, condition), pose, plane)
        dr.backward(dr.mean(dr.square(re * re + im * im - truth)))
        params = {name: dr.detach(value) - RATE * dr.grad(value) for name, value in params.items()}
        yield dr.kernel_history([dr.KernelType.JIT])


@pytest.mark.parametrize("model", FIELDS)
def test_kernels_of_a_loop_of_gradient_descent_do_not_grow(model: str) -> None:
    sizes = {"wrf-gs": {"width": 16, "signal_widths": (16, 8)}, "wrf-gs+": {"width": 16}, "factorised": {"width": 16}}
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        steps = list(gradient_descent(FIELDS[model](encoding=OCTAVES, **sizes[model])))
    known = {kernel["hash"] for step in steps[:FIRST] for kernel in step}
    assert len(steps) == STEPS
    assert {kernel["hash"] for step in steps[FIRST:] for kernel in step} <= known
