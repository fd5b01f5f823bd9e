"""Receiver models by name, and the form of observations that they need.

One class states all of a receiver: its observation of traced paths in NumPy, its differentiable observation in Dr.Jit,
and what the correction of a scene needs of it (`ReceiverModel`). Instruments, the graph and the correction take it from
`RECEIVERS`. Another package adds one by an entry point of the group `ENTRY_POINTS` that names the class. Dr.Jit is
imported with the first class: a command that only reads data does without it.

The traced field is given as paths, the learned one as a complex signal R(u) on directions. Each component is
summed coherently; the two, T and L, then add as complex numbers (``how="coherent"``: abs(T + L)) or as powers
(``how="power"``: sqrt(abs(T)^2 + abs(L)^2)).

| receiver | T | L | observation |
| --- | --- | --- | --- |
| pixel | image of h_m, sum_m h_m exp(-j k p_m . u) | R(u) | magnitude at every pixel u |
| array | image of h_m | image of sum_u w(u) R(u) exp(+j k p_m . u) | magnitude at every pixel u |
| power | h at the origin | sum_u w(u) R(u) over the full sphere | power in dB |
| csi | h at each antenna, on each subcarrier | the same sum, or several: coefficients of a basis | T + L |

with h_m = sum over paths of g (d / d_m) exp(-j k d_m), d_m from the path's image source to element m, and w(u) the
solid angle of a pixel.

A model observes in three ways:

- the call, in Dr.Jit and of the float type of the learned component, with derivatives (complex numbers: pairs re, im);
- `observed`, in NumPy and float64, of `wrf_mi.core.Paths`: the reference, and the observation of a synthetic record;
- `signal_observation` and `signal_slopes`, in NumPy, of signals that a caller has summed over paths already: trials of
  `wrf_mi.correction.path_sum`, thousands of them with few paths changed, where a recorded call costs too much.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Paths, Receiver
from ..core.angles import FloatArray, IntArray
from ..core.carriers import middle_carrier
from ..core.registry import Registry

ENTRY_POINTS = "wrf_mi.receivers"  # group of entry points of receiver models
PIXEL = "pixel"  # the receiver model of the papers
AUTO = "auto"  # the setting that leaves the choice to the task
ComplexArray = NDArray[np.complex128]
Slopes = Callable[[ComplexArray, IntArray], FloatArray]
"""Changes of observations by changes [k, values] of signals of the rows ``which`` [k]."""
Sums = Literal["fields", "elements", "powers"]
"""Sums over paths: of fields at one antenna on each subcarrier, of fields at the elements of an array, or of powers."""
How = Literal["coherent", "power"]  # sum of the traced and the learned field: of complex numbers, or of powers
GAPS = ("floor_db",)
"""Attributes of a specification that may be NaN."""


@dataclass(frozen=True)
class ObservationSpec:
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
    def of_ports(self) -> tuple[ObservationSpec, ...]:
        """Forms at each carrier of rows, or this one alone."""
        if self.carriers_hz is None:
            return (self,)
        return tuple(replace(self, frequencies_hz=np.array([hz]), carriers_hz=None) for hz in self.carriers_hz)


class ReceiverModel(ABC):
    """Model of a receiver: what it observes of the traced and the learned field.

    A class is an entry of `RECEIVERS`, an object is the model of one receiver at one carrier.
    """

    name: ClassVar[str]  #: value of the setting ``receiver``
    tasks: ClassVar[tuple[str, ...]]  #: tasks of its observations
    needs_array: ClassVar[bool] = False  #: whether it needs the receiver's antenna array
    needs_carrier: ClassVar[bool] = False  #: whether it needs the carrier even without a scene
    #: whether the learned component has a level at each receiver, because observations have a unit
    levels: ClassVar[bool] = False
    complex_valued: ClassVar[bool] = False  #: whether observations have a last axis of real and imaginary part
    sphere: ClassVar[bool] = True  #: whether directions cover the full sphere instead of the upper hemisphere

    @classmethod
    @abstractmethod
    def of(cls, form: ObservationSpec, receiver: Receiver) -> ReceiverModel:
        """Model of a receiver whose observations have a form."""

    @property
    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Shape of an observation; complex numbers as a last axis of real and imaginary part."""

    @abstractmethod
    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that an observation reads."""

    @abstractmethod
    def __call__(self, traced: Any, learned: Any) -> Any:
        """Flat observations of a batch, in Dr.Jit and with derivatives.

        Args:
            traced: paths of the batch (`wrf_mi.receivers.device_paths.TracedPaths`), or None.
            learned: complex signal on directions, or None.
        """

    @abstractmethod
    def missing_gain(self, predicted: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the amplitude that predicted observations lack."""

    @property
    def unscaled(self) -> ReceiverModel:
        """The model without an instrument's scaling of each observation."""
        return self

    def with_phase_error(self, phase_error: float) -> ReceiverModel:
        """The model whose observations are expectations over a phase error of each interaction, if it has these."""
        return self

    def observed(self, paths: Paths, receiver: Receiver) -> NDArray[Any]:
        """Observations [n_tx, ...] of the paths to a receiver, in NumPy and float64, as a record holds them."""
        raise InputError(f"receiver model {self.name}: has no observation of traced paths alone; choose another one")

    @property
    def sums(self) -> Sums | None:
        """What `signal_observation` takes; None: it is not defined, and the correction differentiates the call."""
        return None

    @property
    def signal_key(self) -> object:
        """Equal for receivers whose `signal_observation` is the same function."""
        return self

    def signal_observation(self, signal: ComplexArray) -> FloatArray:
        """Observations [n, values] of signals [n, elements] that are summed over paths, in NumPy."""
        raise NotImplementedError

    def signal_slopes(self, parts: Sequence[ComplexArray]) -> Slopes:
        """Derivative of `signal_observation` at parts of signals [n, elements], one after the other."""
        raise NotImplementedError


HOME = "wrf_mi.receivers.receiver_models"
RECEIVERS: Registry[type[ReceiverModel]] = Registry(
    "receiver model",
    ENTRY_POINTS,
    {
        PIXEL: f"{HOME}:PixelReceiver",
        "array": f"{HOME}:ArrayReceiver",
        "power": f"{HOME}:PowerReceiver",
        "csi": f"{HOME}:CsiReceiver",
    },
)
"""Classes of all receiver models by name."""


def register(model: type[ReceiverModel]) -> None:
    """Add a receiver model for this process (`InputError` if its name is taken); packages state `ENTRY_POINTS`."""
    RECEIVERS.add(model.name, model)


def receiver_model(name: str, task: str) -> type[ReceiverModel]:
    """The receiver model of a name, for a task; `InputError` for an unknown name, or a model of another task."""
    able = [key for key in RECEIVERS if task in RECEIVERS[key].tasks]
    if name not in RECEIVERS:
        raise InputError(f"receiver model {name!r}: unknown; choose from {', '.join(able)}")
    if name not in able:
        raise InputError(f"receiver model {name} does not observe {task}; choose from {', '.join(able)}")
    return RECEIVERS[name]
