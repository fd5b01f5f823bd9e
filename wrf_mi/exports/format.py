"""A format of the command ``export``, and the options that a format may take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from ..core import InputError
from ..core.angles import FloatArray

RUN, SCENE, DATASET = "run", "scene", "data set"  # kinds of sources


@dataclass(frozen=True)
class ExportOptions:
    """Options of an export; None where they are not given.

    Attributes:
        tx_pos_m: positions of transmitters [n, 3], metres.
        rx_pos_m: positions of receivers [m, 3], metres.
        frequency_hz: carrier, Hz.
        material: radio material of a bare mesh.
        kinds: kinds of path, separated by commas.
        depth: largest number of interactions of a path.
        replace: replace an existing folder.
        progress: show bars on standard error where a tracer takes time.
    """

    tx_pos_m: FloatArray | None = None
    rx_pos_m: FloatArray | None = None
    frequency_hz: float | None = None
    material: str | None = None
    kinds: str | None = None
    depth: int | None = None
    replace: bool = False
    progress: bool = False


NAMES = {"tx_pos_m": "--tx", "rx_pos_m": "--rx", "frequency_hz": "--frequency"}
NAMES |= {"material": "--material", "kinds": "--paths", "depth": "--depth"}
"""Options that belong to some formats, as the command has them."""


@dataclass(frozen=True)
class Format:
    """A format to export to.

    Attributes:
        name: name, as in ``wrf-mi export --format``.
        kinds: kinds of sources that it takes.
        suffix: ending of the file; "": a folder.
        writer: ``module:function`` of type `wrf_mi.exports.source.Write`, or the function.
        options: names of fields of `ExportOptions` that it takes.
        text: what is written, for the help of the command.
    """

    name: str
    kinds: tuple[str, ...]
    suffix: str
    writer: str | Callable[..., dict[str, Any]]
    options: tuple[str, ...]
    text: str

    def check(self, out: Path, options: ExportOptions) -> None:
        """Refuse a name of the file, or options, that do not belong to the format; `InputError`: naming them."""
        if self.suffix and out.suffix.lower() != self.suffix:
            raise InputError(f"{out}: format {self.name} is a file {self.suffix}; give such a name")
        unset = ExportOptions()
        for field in fields(options):
            foreign = field.name in NAMES and field.name not in self.options
            if foreign and getattr(options, field.name) is not getattr(unset, field.name):
                raise InputError(f"{NAMES[field.name]} does not belong to format {self.name}; omit it")
