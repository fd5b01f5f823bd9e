"""A format of the command ``export``, and the options that a format may take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ...core import InputError
from ...core.angles import FloatArray

RUN, SCENE, DATASET = "run", "scene", "data set"  # kinds of sources


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export; None where they are not stated."""

    tx_pos_m: FloatArray | None = None  # positions of transmitters [n, 3], metres
    rx_pos_m: FloatArray | None = None  # positions of receivers [m, 3], metres
    frequency_hz: float | None = None  # carrier, Hz
    material: str | None = None  # radio material of a bare mesh
    kinds: str | None = None  # kinds of path, separated by commas
    depth: int | None = None  # largest number of interactions of a path
    replace: bool = False  # replace an existing folder
    progress: bool = False  # show bars on standard error where a tracer takes time


NAMES = {"tx_pos_m": "--tx", "rx_pos_m": "--rx", "frequency_hz": "--frequency"}
NAMES |= {"material": "--material", "kinds": "--paths", "depth": "--depth"}
"""Options that belong to some formats, as the command has them."""


@dataclass(frozen=True)
class Format:
    """A format to export to."""

    name: str  # name, as in ``wrf-mi export --format``
    kinds: tuple[str, ...]  # kinds of sources that it takes
    suffix: str  # ending of the file; "": a folder
    writer: str | Callable[..., dict[str, Any]]  # function of type `wrf_mi.apps.exports.source.Write`, or its address
    options: tuple[str, ...]  # names of fields of `ExportOptions` that it takes
    text: str  # what is written, for the help of the command

    def check(self, out: Path, options: ExportOptions) -> None:
        """Refuse a name of the file, or options, that do not belong to the format; `InputError`: naming them."""
        if self.suffix and out.suffix.lower() != self.suffix:
            raise InputError(f"{out}: format {self.name} is a file {self.suffix}; give such a name")
        if self.suffix and options.replace:
            raise InputError(f"--replace belongs to formats that are folders, not to {self.name}; omit it")
        unset = ExportOptions()
        for field in fields(options):
            foreign = field.name in NAMES and field.name not in self.options
            if foreign and getattr(options, field.name) is not getattr(unset, field.name):
                raise InputError(f"{NAMES[field.name]} does not belong to format {self.name}; omit it")
