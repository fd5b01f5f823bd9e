"""Mitsuba plugins: thin adapters that let Mitsuba scenes hold and evaluate learned fields.

    import mitsuba as mi
    mi.set_variant("llvm_ad_mono_polarized")
    import wrf_mi_plugins
    wrf_mi_plugins.register_all()

See `docs/plugins.md`. The modules of this package import Mitsuba; this one does not, so that the variant can be set
first.
"""

from __future__ import annotations

import importlib
import sys

from wrf_mi.backend import VARIANTS, init
from wrf_mi.core import BackendError

MODULES = ("sensor", "integrator", "emitter", "medium")
"""Each has a function ``register``."""

_registered: set[str] = set()


def register_all() -> None:
    """Make every plugin of this package known to Mitsuba's current variant. Calling it again does nothing.

    Raises:
        BackendError: no variant is set, or one in which the plugins do not work.
    """
    mitsuba = sys.modules.get("mitsuba")
    variant = None if mitsuba is None else mitsuba.variant()
    if variant not in VARIANTS.values():
        choices = " or ".join(f'mi.set_variant("{name}")' for name in VARIANTS.values())
        problem = "Mitsuba has no variant set" if variant is None else f"Mitsuba's variant is {variant}"
        raise BackendError(f"register_all: {problem}; call wrf_mi.backend.init(), or {choices}, first")
    init()
    if variant in _registered:
        return
    for name in MODULES:
        importlib.import_module(f".{name}", __name__).register()
    _registered.add(str(variant))
