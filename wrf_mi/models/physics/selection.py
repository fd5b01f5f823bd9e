"""Which physics serves which data: by what is measured, and by whether there is a mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Prediction, Receiver, Record
from ...core.types import IntArray

OnProgress = Callable[[str, float], None]


class PhysicsModel(Protocol):
    """A fitted physics."""

    @property
    def task(self) -> str:
        """``"spectrum"``, ``"rssi"`` or ``"csi"``."""
        ...

    @property
    def receivers(self) -> tuple[Receiver, ...]:
        """Whose observations it predicts."""
        ...

    @property
    def uses_heading(self) -> bool:
        """Whether it predicts from how the transmitter is turned."""
        ...

    def predict(self, tx_pos_m: ArrayLike, receiver: int | str, tx_heading_rad: ArrayLike | None = None) -> Prediction:
        """What a receiver observes of transmitters at [q, 3], metres, turned by [q] rad, and how sure that is.

        The receiver is given by its name, or by its number from 0.

        Raises:
            InputError: positions of another shape or not finite, or no such receiver.
        """
        ...

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        ...

    def summary(self) -> dict[str, Any]:
        """What was fitted, in plain numbers."""
        ...


@dataclass(frozen=True)
class PhysicsKind:
    """One of the physics models.

    Attributes:
        settings: dataclass of its settings.
        fit: ``fit(record, rows, scene, settings, seed, listen)``; ``scene`` as opened by Sionna RT, or None.
        load: ``load(arrays, scene)``, from `PhysicsModel.arrays`.
        uses_antennas: whether its paths have the antennas' patterns and polarisations; else all are isotropic.
    """

    settings: type
    fit: Callable[[Record, IntArray, Any, Any, int, OnProgress], PhysicsModel]
    load: Callable[[dict[str, NDArray[Any]], Any], PhysicsModel]
    uses_antennas: bool = True


def kind_of(record: Record, with_scene: bool) -> PhysicsKind:
    """The physics model for a record.

    Args:
        record: measurements.
        with_scene: whether a mesh of the place is given.

    Raises:
        InputError: a task that none serves, or channels of receivers with several antennas.
    """
    if record.task not in KINDS:
        raise InputError(f"{record.name}: holds {record.task}; no physics model predicts that")
    check_antennas(record)
    return KINDS[record.task](with_scene)


def check_antennas(record: Record) -> None:
    """Refuse channels of receivers with several antennas.

    Raises:
        InputError: naming their number.
    """
    if record.task == "csi" and record.observation.ndim != 3:
        antennas = record.observation.shape[2]
        raise InputError(f"{record.name}: channels of {antennas} antennas; the physics model serves receivers with one")


def _for_rssi(with_scene: bool) -> PhysicsKind:
    from .rssi import RssiPhysics, RssiSettings, fit_rssi

    return PhysicsKind(RssiSettings, fit_rssi, RssiPhysics.from_arrays)


def _for_csi(with_scene: bool) -> PhysicsKind:
    from .csi import CsiPhysics, CsiSettings, fit_csi

    return PhysicsKind(CsiSettings, fit_csi, CsiPhysics.from_arrays, uses_antennas=False)


def _for_spectra(with_scene: bool) -> PhysicsKind:
    if with_scene:
        from .spectrum import SpectrumPhysics, SpectrumSettings, fit_spectrum

        return PhysicsKind(SpectrumSettings, fit_spectrum, SpectrumPhysics.from_arrays)
    from .measured_spectrum import MeasuredSpectrumPhysics, MeasuredSpectrumSettings, fit_measured_spectrum

    def fit(
        record: Record, rows: IntArray, scene: Any, settings: Any, seed: int, on_progress: OnProgress
    ) -> PhysicsModel:
        return fit_measured_spectrum(record, rows, settings, seed, on_progress)

    return PhysicsKind(MeasuredSpectrumSettings, fit, MeasuredSpectrumPhysics.from_arrays)


KINDS: Mapping[str, Callable[[bool], PhysicsKind]] = {"spectrum": _for_spectra, "rssi": _for_rssi, "csi": _for_csi}
"""The physics model with or without a scene, by task."""
