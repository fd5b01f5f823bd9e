"""Every baseline by its name; what one needs is imported when it is asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.util import find_spec

from .method import Method

MODULES = {
    "idw": "idw",
    "kriging": "kriged",
    "trees": "trees",
    "mri": "mri",
    "vae": "vae",
    "dcgan": "dcgan",
    "nerf2": "nerf2",
    "linear": "linear",
    "fire": "fire",
    "r2f2": "r2f2",
    "optml": "optml",
}
"""Modules of this package by the method's name: its `Method` is ``METHOD`` there."""


class _Methods(Mapping[str, Method]):
    """Methods by name, imported one by one: networks bring Dr.Jit, trees scikit-learn."""

    def __init__(self) -> None:
        self._names = tuple(name for name, module in MODULES.items() if find_spec(f"{__package__}.{module}"))

    def __getitem__(self, name: str) -> Method:
        if name not in self._names:
            raise KeyError(name)
        module = import_module(f".{MODULES[name]}", __package__)
        method: Method = module.METHOD
        return method

    def __contains__(self, name: object) -> bool:
        return name in self._names  # without importing it

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


METHODS: Mapping[str, Method] = _Methods()
"""Every baseline by its name."""
