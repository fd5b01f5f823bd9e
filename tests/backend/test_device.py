"""What comes from NumPy is Dr.Jit's own, not read beyond its end; recordings and sums where threads change."""

import ast
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from wrf_mi.backend import set_threads
from wrf_mi.backend.device import ALIGNED_BYTES, PACKET, Recorded, on_device, to_tensor, to_vectors, with_room

SIZES = (0, 1, 5, 16, 1000, 70_001)
ROOT = Path(__file__).parents[2]
PACKAGES = (ROOT / "wrf_mi", ROOT / "plugins" / "wrf_mi_plugins")
OWN = "device.py"
AT_THE_END = """
import ctypes, mmap
import numpy as np
import wrf_mi.backend
wrf_mi.backend.init("llvm")
import drjit as dr, mitsuba as mi
from wrf_mi.backend.device import on_device

# The last numbers of a page before one that nobody may read.
memory = mmap.mmap(-1, 2 * mmap.PAGESIZE)
place = ctypes.addressof(ctypes.c_char.from_buffer(memory))
assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(place + mmap.PAGESIZE), ctypes.c_size_t(mmap.PAGESIZE), 0) == 0
values = np.frombuffer(memory, np.float32, 5, mmap.PAGESIZE - 20)
values[:] = range(5)
print(*on_device(values, mi.Float).numpy())
"""


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", [mi.Float, mi.UInt32, mi.Int32, mi.Bool, mi.Float64])
def test_values_are_copied(size, kind):
    values = np.arange(size) % 7 - (3 if kind in (mi.Float, mi.Int32, mi.Float64) else 0)
    array = on_device(values, kind)
    expected = values.astype(array.numpy().dtype)
    values[:] = 0
    np.testing.assert_array_equal(array.numpy(), expected)
    assert array.state in (dr.VarState.Evaluated, dr.VarState.Invalid)


@pytest.mark.parametrize("size", SIZES)
def test_wrapped_arrays_are_padded_by_a_packet(size):
    room = with_room(np.ones(size), np.float32)
    memory = room.base
    while memory.base is not None:
        memory = memory.base
    assert memory.ctypes.data + memory.nbytes - (room.ctypes.data + size * room.itemsize) >= PACKET * room.itemsize
    assert size == 0 or room.ctypes.data % ALIGNED_BYTES == 0  # NumPy states no address of nothing


def test_shapes_and_columns():
    values = np.arange(12.0).reshape(4, 3)
    np.testing.assert_array_equal(to_tensor(values).numpy(), values)
    for rows, kind in ((values, mi.Point3f), (values[::2, :2], mi.Vector2f)):
        np.testing.assert_array_equal(to_vectors(rows, kind).numpy(), rows.T)


@pytest.mark.skipif(sys.platform != "linux", reason="protects a page by Linux's C library")
def test_device_copies_read_within_bounds():
    done = subprocess.run([sys.executable, "-c", AT_THE_END], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.split()) == (0, ["0.0", "1.0", "2.0", "3.0", "4.0"]), done.stderr


ARRAYS = re.compile(r"(mi\.(Float|U?Int|Bool|Mask|Tensor|Point|Vector|Normal)\w*|kind|\w+_type)\(")
"""Beginnings of calls that make a Dr.Jit array."""
NUMPY = re.compile(r"\bnp\.(ascontiguousarray|asarray|array|arange|where|stack|concatenate|ravel|repeat)\(|\.astype\(")


def wraps(code: str) -> bool:
    """Whether a call makes a Dr.Jit array straight from NumPy's; lists are copied."""
    return bool(ARRAYS.match(code) and NUMPY.search(code)) and ".tolist()" not in code


def test_only_the_device_module_wraps_numpy():
    assert wraps("mi.Float(x.astype(np.float32))")
    assert not wraps("mi.UInt32(np.asarray(rows).tolist())")
    wrapped = []
    for path in (path for package in PACKAGES for path in package.rglob("*.py") if path.name != OWN):
        calls = (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call))
        wrapped += [f"{path.name}:{call.lineno}: {code}" for call in calls if wraps(code := ast.unparse(call))]
    assert not wrapped


TERMS, SUMS = 1 << 20, 4096
CALLS = 30
"""On four threads, most calls went wrong while sums had room for one."""


def sums(value: Any) -> Any:
    """[SUMS] sums of TERMS / SUMS equal terms."""
    total, index = dr.zeros(mi.Float, SUMS), dr.arange(mi.UInt32, TERMS) & (SUMS - 1)
    dr.scatter_reduce(dr.ReduceOp.Add, total, value + dr.zeros(mi.Float, TERMS), index)
    return total


def always(call: Callable[[], Any]) -> None:
    """Each call gives the sums of ones."""
    for _ in range(CALLS):
        np.testing.assert_array_equal(call().numpy(), TERMS / SUMS)


def test_functions_are_recorded_again_for_more_threads():
    recorded, term = Recorded(sums), dr.opaque(mi.Float, 1)
    for threads in (1, 4, 2):
        set_threads(threads)
        always(lambda: recorded(term))
        assert recorded.frozen.n_recordings == 1


@pytest.mark.parametrize(("before", "after"), [(1, 4), (4, 1)])
def test_pending_sums_are_evaluated_before_threads_change(before, after):
    def waited() -> Any:
        set_threads(before)
        total = sums(mi.Float(1))
        set_threads(after)
        return total

    always(waited)
