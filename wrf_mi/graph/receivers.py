"""Receiver models by name, and what of the observations they need to know.

A receiver model is a callable of two sides, the paths of a batch and the learned signal on directions, either of which
may be None, that gives flat observations (see `wrf_mi.graph.combine`). Another package adds one by an entry point of
the group `ENTRY_POINTS` that names a `ReceiverKind`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Receiver
from ..core.angles import FloatArray
from ..core.registry import Registry
from .combine import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver

ENTRY_POINTS = "wrf_mi.receivers"
"""Group of the entry points by which other packages add receiver models."""
PIXEL = "pixel"
"""The receiver model of the papers."""
AUTO = "auto"
"""The setting that leaves the choice to the task."""


class ReceiverModel(Protocol):
    """How two sides become what an instrument reports.

    Attributes:
        sphere: whether directions are those of the full sphere, or else of the upper hemisphere.
        shape: of one report; complex numbers as a last axis of real and imaginary part.
    """

    @property
    def sphere(self) -> bool:
        """See above."""
        ...

    @property
    def shape(self) -> tuple[int, ...]:
        """See above."""
        ...

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that a report reads."""
        ...

    def __call__(self, traced: Any, learned: Any) -> Any:
        """Reports of a batch, flat."""
        ...

    def missing_gain(self, report: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the amplitude by which reports are too weak."""
        ...


@dataclass(frozen=True)
class Form:
    """What observations are made of, beside the receivers' poses, antennas and arrays.

    Attributes:
        receiver: name of the receiver model, a key of `RECEIVERS`.
        size: elevations and azimuths of the learned signal's directions; for spectra those of the image.
        frequencies_hz: of the carrier [1] or of subcarriers [k]; None: not known.
        outputs: shape of a channel: subcarriers, or antennas and subcarriers; () for other observations.
        basis: complex [components, outputs] that learned channels are sums of; None: no channels.
        features: number of features that tell of a transmitter in place of its position; 0: its position.
        headings: whether the transmitters' antenna turns with their headings, which then are known.
    """

    receiver: str
    size: tuple[int, int]
    frequencies_hz: FloatArray | None = None
    outputs: tuple[int, ...] = ()
    basis: NDArray[np.complex128] | None = field(default=None, repr=False)
    features: int = 0
    headings: bool = False

    def arrays(self) -> dict[str, NDArray[Any]]:
        """As arrays, for a file."""
        hz = np.array([np.nan]) if self.frequencies_hz is None else np.asarray(self.frequencies_hz, float)
        return {
            "form/receiver": np.asarray(self.receiver),
            "form/size": np.asarray(self.size),
            "form/frequencies_hz": hz,
            "form/outputs": np.asarray(self.outputs, np.int64),
            "form/basis": np.zeros((0, 0), complex) if self.basis is None else self.basis,
            "form/features": np.asarray(self.features),
            "form/headings": np.asarray(self.headings),
        }

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray[Any]]) -> Form:
        """What `arrays` described."""
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
        )

    @property
    def components(self) -> int:
        """Complex signals of a Gaussian."""
        return 1 if self.basis is None else len(self.basis)

    @property
    def carrier_hz(self) -> float:
        """The middle of the frequencies; NaN where they are not known."""
        return float("nan") if self.frequencies_hz is None else float(np.mean(self.frequencies_hz))


@dataclass(frozen=True)
class ReceiverKind:
    """A receiver model that a setting can name.

    Attributes:
        name: as in the setting ``receiver``.
        tasks: whose observations it reports.
        make: ``make(form, receiver)``: the model of one receiver.
        needs_array: whether it needs the receiver's antenna array.
        needs_carrier: whether it needs the carrier, without a scene too.
        levels: whether the learned side has a level at each receiver: what it reports has a unit of its own.
        complex_valued: whether reports are complex: a last axis of real and imaginary part.
    """

    name: str
    tasks: tuple[str, ...]
    make: Callable[[Form, Receiver], ReceiverModel]
    needs_array: bool = False
    needs_carrier: bool = False
    levels: bool = False
    complex_valued: bool = False


def _elements(receiver: Receiver) -> FloatArray:
    return np.zeros((0, 3)) if receiver.array_m is None else np.asarray(receiver.array_m, float)


def _pixel(form: Form, receiver: Receiver) -> PixelReceiver:
    return PixelReceiver(*form.size, _elements(receiver), form.carrier_hz)


def _array(form: Form, receiver: Receiver) -> ArrayReceiver:
    return ArrayReceiver(*form.size, _elements(receiver), form.carrier_hz, instrument_scale=True)


def _power(form: Form, receiver: Receiver) -> PowerReceiver:
    known = form.frequencies_hz is not None
    # As the instrument of the task: powers of paths are added.
    return PowerReceiver(*form.size, (form.carrier_hz if known else 0.0,), interference=False)


def _csi(form: Form, receiver: Receiver) -> CsiReceiver:
    # Where frequencies are not known no path is evaluated. Narrow channels may come with their carrier alone.
    known = 0.0 if form.frequencies_hz is None else form.frequencies_hz
    tones = tuple(map(float, np.broadcast_to(known, form.outputs[-1:])))
    elements = None
    if len(form.outputs) > 1 and not form.features:  # by uplink each antenna is a condition of its own
        elements = np.zeros((form.outputs[0], 3)) if receiver.array_m is None else np.asarray(receiver.array_m, float)
    return CsiReceiver(*form.size, tones, elements, form.basis)


_OWN = (
    ReceiverKind(PIXEL, ("spectrum",), _pixel),
    ReceiverKind("array", ("spectrum",), _array, needs_array=True, needs_carrier=True),
    ReceiverKind("power", ("rssi",), _power, levels=True),
    ReceiverKind("csi", ("csi",), _csi, levels=True, complex_valued=True),
)
_RECEIVERS = Registry[ReceiverKind]("receiver model", ENTRY_POINTS, {kind.name: kind for kind in _OWN})
RECEIVERS: Mapping[str, ReceiverKind] = _RECEIVERS
"""Every receiver model by its name."""


def register(kind: ReceiverKind) -> None:
    """Add a receiver model for this process; an installed package names it by an entry point of `ENTRY_POINTS`.

    Raises:
        InputError: a name that is taken.
    """
    _RECEIVERS.add(kind.name, kind)


def receiver_kind(name: str, task: str) -> ReceiverKind:
    """The receiver model of a name, for a task.

    Raises:
        InputError: none of that name, or one of another task.
    """
    able = [known for known in RECEIVERS if task in RECEIVERS[known].tasks]
    if name not in RECEIVERS:
        raise InputError(f"receiver model {name!r}: unknown; choose from {', '.join(able)}")
    if name not in able:
        raise InputError(f"receiver model {name} does not report {task}; choose from {', '.join(able)}")
    return RECEIVERS[name]
