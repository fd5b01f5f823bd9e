"""Receiver models by name, and the form of observations that they need.

A receiver model is a callable of two sides, the paths of a batch and the learned signal on directions, either of which
may be None; it returns flat observations (see `wrf_mi.receivers.receiver_models`). Another package adds a model by an
entry point of the group `ENTRY_POINTS` that names a `ReceiverKind`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver
from ..core.angles import FloatArray
from ..core.carriers import middle_carrier
from ..core.registry import Registry
from ..receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver
from ..receivers.reports import LEAST_POWER

ENTRY_POINTS = "wrf_mi.receivers"  # group of entry points of receiver models
PIXEL = "pixel"  # the receiver model of the papers
AUTO = "auto"  # the setting that leaves the choice to the task


class ReceiverModel(Protocol):
    """Combination of two sides to the report of an instrument."""

    @property
    def sphere(self) -> bool:
        """Whether directions cover the full sphere instead of the upper hemisphere."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a report; complex numbers as a last axis of real and imaginary part."""

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that a report reads."""

    def __call__(self, traced: Any, learned: Any) -> Any:
        """Reports of a batch, flat."""

    def missing_gain(self, report: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the missing amplitude of reports."""


GAPS = ("frequencies_hz", "floor_db")  # attributes of `Form` that are NaN where they are unknown, or there is none


@dataclass(frozen=True)
class Form:
    """Form of observations, beside the receivers' poses, antennas and arrays.

    Attributes:
        receiver: name of the receiver model, a key of `RECEIVERS`.
        size: elevations and azimuths of the learned signal's directions; for spectra those of the image.
        frequencies_hz: carrier [1] or subcarriers [k]; None: unknown, or that of each row.
        outputs: shape of a channel: subcarriers, or antennas and subcarriers; () for other observations.
        basis: complex [components, outputs] that learned channels are sums of; None: no channels.
        features: number of features that describe a transmitter in place of its position; 0: its position.
        headings: whether the transmitters' antenna turns with their (known) headings.
        floor_db: power in dB that is received where no path arrives; NaN: none.
        carriers_hz: carriers of rows, ascending; None: all rows have the same.
    """

    receiver: str
    size: tuple[int, int]
    frequencies_hz: FloatArray | None = None
    outputs: tuple[int, ...] = ()
    basis: NDArray[np.complex128] | None = field(default=None, repr=False)
    features: int = 0
    headings: bool = False
    floor_db: float = float("nan")
    carriers_hz: FloatArray | None = None

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Arrays for a file."""
        hz = np.array([np.nan]) if self.frequencies_hz is None else np.asarray(self.frequencies_hz, float)
        basis = np.zeros((0, 0), complex) if self.basis is None else self.basis
        carriers = np.zeros(0) if self.carriers_hz is None else np.asarray(self.carriers_hz, float)
        values = vars(self) | {"frequencies_hz": hz, "outputs": np.asarray(self.outputs, np.int64), "basis": basis}
        values["carriers_hz"] = carriers
        return {f"form/{name}": np.asarray(value) for name, value in values.items()}

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Form:
        """The form that `arrays` describes."""
        height, width = map(int, arrays["form/size"])
        hz, basis = np.asarray(arrays["form/frequencies_hz"], float), np.asarray(arrays["form/basis"])
        return cls(
            str(arrays["form/receiver"]),
            (height, width),
            None if np.isnan(hz).any() else hz,
            tuple(map(int, arrays["form/outputs"])),
            basis if basis.size else None,
            int(arrays["form/features"]),
            bool(arrays["form/headings"]),
            float(arrays["form/floor_db"]),
            carriers if (carriers := arrays.get("form/carriers_hz", np.zeros(0))).size else None,
        )

    @property
    def components(self) -> int:
        """Number of complex signals of a Gaussian."""
        return 1 if self.basis is None else len(self.basis)

    @property
    def carrier_hz(self) -> float:
        """Mean of the frequencies, or the middle carrier of rows; NaN where they are unknown."""
        if self.carriers_hz is not None:
            return middle_carrier(self.carriers_hz)
        return float("nan") if self.frequencies_hz is None else float(np.mean(self.frequencies_hz))

    @property
    def of_ports(self) -> tuple[Form, ...]:
        """Forms at each carrier of rows, or this one alone."""
        if self.carriers_hz is None:
            return (self,)
        return tuple(replace(self, frequencies_hz=np.array([hz]), carriers_hz=None) for hz in self.carriers_hz)


@dataclass(frozen=True)
class ReceiverKind:
    """A receiver model that a setting can name.

    Attributes:
        name: value of the setting ``receiver``.
        tasks: tasks whose observations it reports.
        make: ``make(form, receiver)``, the model of a receiver.
        needs_array: whether it needs the receiver's antenna array.
        needs_carrier: whether it needs the carrier even without a scene.
        levels: whether the learned side has a level at each receiver, because reports have a unit.
        complex_valued: whether reports are complex: a last axis of real and imaginary part.
    """

    name: str
    tasks: tuple[str, ...]
    make: Callable[[Form, Receiver], ReceiverModel]
    needs_array: bool = False
    needs_carrier: bool = False
    levels: bool = False
    complex_valued: bool = False


def _elements(receiver: Receiver, count: int = 0) -> FloatArray:
    return np.zeros((count, 3)) if receiver.array_m is None else np.asarray(receiver.array_m, float)


def _array(form: Form, receiver: Receiver) -> ArrayReceiver:
    return ArrayReceiver(*form.size, _elements(receiver), form.carrier_hz, instrument_scale=True)


def _power(form: Form, receiver: Receiver) -> PowerReceiver:
    known = form.frequencies_hz is not None
    # As the instrument of the task: powers of paths are added.
    floor = LEAST_POWER if np.isnan(form.floor_db) else 10 ** (form.floor_db / 10)
    return PowerReceiver(*form.size, (form.carrier_hz if known else 0.0,), interference=False, floor=floor)


def _csi(form: Form, receiver: Receiver) -> CsiReceiver:
    # Without frequencies no path is evaluated. Narrow channels may state their carrier alone.
    known = 0.0 if form.frequencies_hz is None else form.frequencies_hz
    tones = tuple(map(float, np.broadcast_to(known, form.outputs[-1:])))
    # With features (uplink) each antenna has a condition, so the model has one antenna.
    several = len(form.outputs) > 1 and not form.features
    return CsiReceiver(*form.size, tones, _elements(receiver, form.outputs[0]) if several else None, form.basis)


_BUILT_IN = (
    ReceiverKind(PIXEL, ("spectrum",), lambda form, rx: PixelReceiver(*form.size, _elements(rx), form.carrier_hz)),
    ReceiverKind("array", ("spectrum",), _array, needs_array=True, needs_carrier=True),
    ReceiverKind("power", ("rssi",), _power, levels=True),
    ReceiverKind("csi", ("csi",), _csi, levels=True, complex_valued=True),
)
_RECEIVERS = Registry[ReceiverKind]("receiver model", ENTRY_POINTS, {kind.name: kind for kind in _BUILT_IN})
RECEIVERS: Mapping[str, ReceiverKind] = _RECEIVERS  # all receiver models by name


def register(kind: ReceiverKind) -> None:
    """Add a receiver model for this process (`InputError` if its name is taken); packages state `ENTRY_POINTS`."""
    _RECEIVERS.add(kind.name, kind)


def receiver_kind(name: str, task: str) -> ReceiverKind:
    """The receiver model of a name, for a task; `InputError` for an unknown name, or a model of another task."""
    able = [known for known in RECEIVERS if task in RECEIVERS[known].tasks]
    if name not in RECEIVERS:
        raise InputError(f"receiver model {name!r}: unknown; choose from {', '.join(able)}")
    if name not in able:
        raise InputError(f"receiver model {name} does not report {task}; choose from {', '.join(able)}")
    return RECEIVERS[name]
