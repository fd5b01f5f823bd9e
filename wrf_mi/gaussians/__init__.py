"""Learned fields of Gaussians: parameters, starting values, networks, splatting and operators."""

from ..backend import init

# Dr.Jit loads an LLVM when it is imported, so the choice must be made before.
init()

from .attributes import ATTRIBUTES, GaussianAttribute, WithAttributes
from .fields import Encoding, Factorised, WrfGs, WrfGsPlus
from .initial import InitialGaussians, gaussians_from_points, random_gaussians
from .parameters import Gaussians, rows

FIELDS = {"wrf-gs": WrfGs, "wrf-gs+": WrfGsPlus, "factorised": Factorised}  # by name of ``--model``

__all__ = [
    "ATTRIBUTES",
    "FIELDS",
    "Encoding",
    "Factorised",
    "GaussianAttribute",
    "Gaussians",
    "InitialGaussians",
    "WithAttributes",
    "WrfGs",
    "WrfGsPlus",
    "gaussians_from_points",
    "random_gaussians",
    "rows",
]
