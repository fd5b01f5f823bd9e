"""Trial of Dr.Jit with one library; run as a script in a separate process.

``python trial.py VARIANT`` prints one JSON line with the version and the device and ends with status 0,
or fails; an LLVM that lacks an instruction ends the process with SIGABRT. It imports Dr.Jit and Mitsuba only.
"""

from __future__ import annotations

import contextlib
import json
import math
import sys
from typing import Any

N = 100  # not a multiple of any vector width, so that the tail is compiled too

RELATIVE_TOLERANCE = 1e-5  # single precision with approximate reciprocals and square roots


def check_arithmetic(dr: Any, number: Any) -> None:
    """Minimum and maximum (which LLVM 15 and 16 lack) and common functions, against Python's functions."""
    x = dr.arange(number, N) * 0.25 - 10
    bounded = dr.minimum(dr.maximum(x, -3), 5)
    value = dr.sin(bounded) + dr.sqrt(bounded + 4) * dr.exp2(-bounded) + dr.select(x > 0, dr.rcp(x + 20), 0)
    for i, result in enumerate(value):
        u = i * 0.25 - 10
        v = min(max(u, -3), 5)
        expected = math.sin(v) + math.sqrt(v + 4) * 2**-v + (1 / (u + 20) if u > 0 else 0)
        if not math.isclose(result, expected, rel_tol=RELATIVE_TOLERANCE, abs_tol=RELATIVE_TOLERANCE):
            raise ArithmeticError(f"wrong result in {number.__name__}: {result} instead of {expected}")


def check_derivative(dr: Any, mi: Any) -> None:
    """A loop, a scattered sum and a reverse pass."""
    x = dr.full(mi.Float, 2, N)
    dr.enable_grad(x)
    sums = dr.zeros(mi.Float, 2)
    dr.scatter_add(sums, dr.maximum(x * x, 1), dr.arange(mi.UInt, N) & 1)
    dr.backward(dr.sum(sums))
    _, total = dr.while_loop(
        (mi.UInt(0), dr.zeros(mi.Float, N)), lambda i, s: i < 3, lambda i, s: (i + 1, s + dr.minimum(s + 1, 2))
    )
    if not (dr.all(dr.abs(x.grad - 4) < RELATIVE_TOLERANCE) and dr.all(total == 5)):
        raise ArithmeticError("wrong derivative or loop")


def check_rays(mi: Any) -> None:
    """One ray against a sphere: Embree on the CPU, OptiX on the GPU."""
    scene = mi.load_dict({"type": "scene", "sphere": {"type": "sphere"}})
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, -3), mi.Vector3f(0, 0, 1)))
    if not math.isclose(hit.t[0], 2, rel_tol=RELATIVE_TOLERANCE):
        raise ArithmeticError(f"wrong distance to a sphere: {hit.t[0]} instead of 2")


def cuda_device() -> str:
    """Name of the first device, from the driver (CUDA driver API, ``cuDeviceGetName``)."""
    import ctypes
    import os

    def check(status: int) -> None:
        if status:
            raise RuntimeError(f"the NVIDIA driver reports error {status}")

    driver = ctypes.CDLL(os.environ["DRJIT_LIBCUDA_PATH"])
    device, name = ctypes.c_int(), ctypes.create_string_buffer(256)
    check(driver.cuInit(0))
    check(driver.cuDeviceGet(ctypes.byref(device), 0))
    check(driver.cuDeviceGetName(name, len(name), device))
    return name.value.decode()


def main(variant: str) -> None:
    """Run all checks and print version and device."""
    with contextlib.suppress(ImportError):
        import resource

        # A failed trial leaves no core file.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    cuda = variant.startswith("cuda")
    device = cuda_device() if cuda else ""
    import drjit as dr

    backend = dr.JitBackend.CUDA if cuda else dr.JitBackend.LLVM
    if not dr.has_backend(backend):
        raise RuntimeError("Dr.Jit finds no LLVM in it that it can use")
    import mitsuba as mi

    mi.set_variant(variant)
    check_arithmetic(dr, mi.Float)
    check_arithmetic(dr, mi.Float64)
    check_derivative(dr, mi)
    check_rays(mi)
    version = dr.detail.cuda_version() if cuda else dr.detail.llvm_version()
    print(json.dumps({"version": list(version), "device": device}))


if __name__ == "__main__":
    main(sys.argv[1])
