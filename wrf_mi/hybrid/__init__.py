"""Traced and learned fields combined at a receiver, in one differentiable graph."""

from .. import backend

# Dr.Jit loads an LLVM of its own choice when it is imported: ours must be chosen before.
backend.init()

from .combine import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver  # noqa: E402
from .learned import learned_field  # noqa: E402
from .traced import TracedField, TracedOptions, TracedPaths  # noqa: E402

__all__ = [
    "ArrayReceiver",
    "CsiReceiver",
    "PixelReceiver",
    "PowerReceiver",
    "TracedField",
    "TracedOptions",
    "TracedPaths",
    "learned_field",
]
