"""What a model predicts from (`Inputs`), and the short form of a model: one fitted to a record's rows alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import NDArray

from ..core import Record, Split
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..training.session import FitSession


@dataclass(frozen=True)
class Inputs:
    """What a method may know of m rows that it predicts; never their observation.

    Attributes:
        tx_pos_m: positions of the moving end [m, 3], metres; NaN where the data do not tell.
        tx_heading_rad: how the transmitter is turned [m], or None.
        uplink: uplink channel coefficients [m, antennas, subcarriers], complex64, or None.
        first_row: number of the first row, for messages.
        carriers_hz: carrier of each row [m], Hz, or None where the data have one.
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
        """Some of them."""
        heading, uplink, carriers = self.tx_heading_rad, self.uplink, self.carriers_hz
        return Inputs(
            self.tx_pos_m[chosen],
            None if heading is None else heading[chosen],
            None if uplink is None else uplink[chosen],
            self.first_row + (chosen.start or 0),
            None if carriers is None else carriers[chosen],
        )


def inputs_of(record: Record, rows: IntArray) -> Inputs:
    """The inputs of some rows of a record."""
    heading, uplink, carriers = record.tx_heading_rad, record.uplink, record.carriers_hz
    return Inputs(
        record.tx_pos_m[rows],
        None if heading is None else heading[rows],
        None if uplink is None else uplink[rows],
        carriers_hz=None if carriers is None else carriers[rows],
    )


class Fitted(Protocol):
    """What a `Method` has fitted."""

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """What the receiver of that index observes, [m, ...] as in `wrf_mi.core.Record`."""
        ...

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again: no key begins with ``run/``."""
        ...


@dataclass(frozen=True)
class Method:
    """A model that is fitted to a record's rows alone, see `wrf_mi.models.Model` for all others.

    Attributes:
        name: as in ``wrf-mi train --model``.
        tasks: tasks of `wrf_mi.core.Record` that it serves; None: all.
        settings: frozen dataclass of its settings, all with defaults.
        fit: ``fit(record, split, settings, seed, session)``. ``split.validation`` may choose what is open; what is
            returned has seen all of ``split.all_train`` and no other row. What is trained step by step keeps a
            checkpoint in the session's folder, from which it goes on; all else tells ``session.report`` of progress.
        load: ``load(arrays, record)``, from `Fitted.arrays` and the record without its observations in mind: poses,
            frequencies and shapes only.
        source: where the method is from.
        needs_uplink: whether it predicts from the uplink alone.
        several_carriers: whether it serves rows of several carriers (`wrf_mi.core.Record.carriers_hz`).
    """

    name: str
    tasks: tuple[str, ...] | None
    settings: type
    fit: Callable[[Record, Split, Any, int, FitSession], Fitted]
    load: Callable[[dict[str, NDArray[Any]], Record], Fitted]
    source: str
    needs_uplink: bool = False
    several_carriers: bool = False

    def serves(self, task: str) -> bool:
        """Whether it serves a task."""
        return self.tasks is None or task in self.tasks
