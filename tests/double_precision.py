"""Tensors of Dr.Jit in double precision on the present backend."""

from typing import Any

import drjit as dr

from wrf_mi.backend.vectors import Float64

Tensor64: Any = dr.tensor_t(Float64)
