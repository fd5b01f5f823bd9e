"""Inputs of predictions, and the short form of a model: a method that is fitted to a record's rows alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from ..core import Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..training.session import FitSession

OnProgress = Callable[[str, float], None]
"""Progress callback: stage, and fraction of it that is done, 0 to 1."""
PER_ROW = ("tx_pos_m", "tx_heading_rad", "uplink", "carriers_hz")
"""Attributes that `Inputs` and `wrf_mi.core.Record` share."""


@dataclass(frozen=True)
class Inputs:
    """Known quantities of m rows to predict; never their observations.

    Attributes:
        tx_pos_m: positions of the transmitter [m, 3], metres; NaN where unknown.
        tx_heading_rad: headings of the transmitter [m], or None.
        uplink: uplink channel coefficients [m, antennas, subcarriers], complex64, or None.
        first_row: number of the first row, for messages.
        carriers_hz: carrier of each row [m], Hz, or None where the data have a single carrier.
    """

    tx_pos_m: FloatArray
    tx_heading_rad: FloatArray | None = None
    uplink: NDArray[Any] | None = None
    first_row: int = 0
    carriers_hz: FloatArray | None = None

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.tx_pos_m)

    def rows(self, chosen: slice) -> Inputs:
        """Inputs of some rows."""
        return Inputs(**_chosen(self, chosen), first_row=self.first_row + (chosen.start or 0))


def inputs_of(record: Record, rows: IntArray) -> Inputs:
    """Inputs of some rows of a record."""
    return Inputs(**_chosen(record, rows))


def _chosen(source: Inputs | Record, rows: slice | IntArray) -> dict[str, Any]:
    every = {name: getattr(source, name) for name in PER_ROW}
    return {name: None if values is None else values[rows] for name, values in every.items()}


class FittedRows(Protocol):
    """A fitted `Method`."""

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """Observations of the receiver of that index, [m, ...] as in `wrf_mi.core.Record`."""

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that `Method.load` needs: no key begins with ``run/``."""


@dataclass(frozen=True)
class Method:
    """A model that is fitted to a record's rows alone, see `wrf_mi.models.Model` for all others.

    Attributes:
        name: name as in ``wrf-mi train --model``.
        tasks: tasks that it serves; None: all.
        settings: frozen dataclass of its settings, all with defaults.
        fit: ``fit(record, split, settings, seed, session)``. ``split.validation`` may choose settings; the result uses
            all of ``split.all_train`` and no other row. Training step by step keeps a checkpoint in the session's
            folder and continues from it; all other fits call ``session.report``.
        load: ``load(arrays, record)``, from `FittedRows.arrays` and poses, frequencies and shapes of the record.
        source: publication.
        needs_uplink: whether it predicts from the uplink alone.
        several_carriers: whether it serves rows of several carriers (`wrf_mi.core.Record.carriers_hz`).
    """

    name: str
    tasks: tuple[str, ...] | None
    settings: type
    fit: Callable[[Record, Split, Any, int, FitSession], FittedRows]
    load: Callable[[dict[str, NDArray[Any]], Record], FittedRows]
    source: str
    needs_uplink: bool = False
    several_carriers: bool = False
