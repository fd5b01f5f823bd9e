"""Records and predictions as `xarray.Dataset` with named dimensions, and records from such data.

Dimensions of an observation are ``row``, ``receiver`` and `wrf_mi.core.Task.dimensions`; variables have the names of
`wrf_mi.datasets.record_file`, coordinates are ``receiver`` (names), ``axis`` (x, y, z) and, of spectra, ``elevation``
and ``azimuth`` in degrees in the frame of the array.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction, Receiver, Record, Task, receiver_arrays
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA, UPRIGHT
from ..core.task import TASKS, task_named
from .record_file import record_arrays, record_from_arrays

if TYPE_CHECKING:
    import xarray

PAIR = ("row", "receiver")
OF_RECEIVERS = ("observation", "truth", "std", "n_readings")  # arrays whose first axes are receiver and row
ROW, FIXED = ("row",), ("receiver",)
DIMENSIONS: dict[str, tuple[str, ...]] = {
    "tx_pos_m": ("row", "axis"),
    **dict.fromkeys(("tx_heading_rad", "carriers_hz", "folds", "runs"), ROW),
    "uplink": ("row", "uplink_antenna", "uplink_subcarrier"),
    "uplink_hz": ("uplink_subcarrier",),
    "tx_antenna": ("antenna_attribute",),
    "train": ("train_row",),
    "test": ("test_row",),
    "receiver_position_m": ("receiver", "axis"),
    "receiver_orientation_xyzw": ("receiver", "quaternion"),
    "receiver_antenna": ("receiver", "antenna_attribute"),
    "receiver_elements_m": ("element", "axis"),
    **dict.fromkeys(("receiver_elements", "receiver_frequency_hz"), FIXED),
}
"""Dimensions of the other variables."""
UNITS = {"_m": "m", "_hz": "Hz", "_rad": "rad", "_deg": "degree"}  # by the end of a name


def xarray_package() -> Any:
    """The package xarray; `InputError`: it is not installed."""
    try:
        return import_module("xarray")
    except ModuleNotFoundError:
        raise InputError("named dimensions need xarray: pip install '.[maps]'") from None


def ordered(values: Any, *dims: str) -> Any:
    """Values of an `xarray.DataArray` with its dimensions in this order; other values as they are."""
    if not hasattr(values, "dims"):
        return values
    if set(values.dims) != set(dims):
        raise InputError(f"dimensions {', '.join(map(str, values.dims))}: name them {', '.join(dims)}")
    return values.transpose(*dims).to_numpy()


def of_receivers(values: Any, receivers: Sequence[Receiver]) -> Any:
    """Observations [n_rx, m] of an `xarray.DataArray` by the names of its receivers; other values as they are."""
    if "receiver" not in getattr(values, "coords", ()):
        return ordered(values, "receiver", "row")
    names = [receiver.name for receiver in receivers]
    if unknown := sorted({*names} - {*map(str, values["receiver"].values)}):
        raise InputError(f"no observations of receiver {unknown[0]}; give NaN where it received nothing")
    return ordered(values.sel(receiver=names), "receiver", "row")


def _observed(task: Task, ndim: int) -> tuple[str, ...]:
    return task.dimensions.get(ndim - len(PAIR), ())


def _labels(names: Sequence[str], task: Task, shape: tuple[int, ...]) -> dict[str, Any]:
    """Coordinates of observations [n_rx, rows, ...]."""
    labels: dict[str, Any] = {"receiver": list(names), "axis": list("xyz")}
    for name, count, span in zip(task.dimensions[2], task.image_size(shape), (90, 360), strict=False):
        labels[name] = name, np.arange(count) * span / count, {"units": "degree"}
    return labels


def _variable(name: str, values: NDArray[Any], task: Task) -> tuple[tuple[str, ...], NDArray[Any], dict[str, str]]:
    units = next((unit for end, unit in UNITS.items() if name.endswith(end)), None)
    if name in (*OF_RECEIVERS, "prediction", "std_mean"):
        unit = "" if name == "n_readings" else task.units[name.startswith("std")]
        return (*PAIR, *_observed(task, values.ndim)), values.swapaxes(0, 1), {"units": unit} if unit else {}
    if name == "frequencies_hz":
        dims: tuple[str, ...] = (task.frequency_dimension,)
    else:
        dims = DIMENSIONS[name]
    return dims, values, {"units": units} if units else {}


def dataset_of(record: Record) -> xarray.Dataset:
    """The record as a dataset, without loss; `record_of` gives an equal one (`InputError`: xarray is missing)."""
    arrays = record_arrays(record)
    names = arrays.pop("receiver_name").tolist()
    variables = {name: _variable(name, np.asarray(values), record.task) for name, values in arrays.items()}
    labels = _labels(names, record.task, record.observation.shape)
    return xarray_package().Dataset(variables, labels, {"name": record.name, "task": record.task.name})


def record_of(data: Any) -> Record:
    """Record of a dataset, or of an array of observations, with the dimensions of `dataset_of` in any order.

    ``observation`` (row, receiver, ...) is needed, and positions: ``tx_pos_m`` (row, axis), or coordinates x, y and z
    of the rows. Receivers without ``receiver_position_m`` have unknown positions.

    Raises:
        InputError: a variable that is missing or has other dimensions, or xarray is missing.
    """
    dataset = data if hasattr(data, "data_vars") else data.to_dataset(name="observation").assign_attrs(data.attrs)
    with_positions = "tx_pos_m" in dataset or {*"xyz"} <= {*dataset.coords}
    lacking = {"observation": "observation" not in dataset, "tx_pos_m": not with_positions}
    lacking |= {name: ("train" in dataset or "test" in dataset) and name not in dataset for name in ("train", "test")}
    for name, is_lacking in lacking.items():
        if is_lacking:
            raise InputError(f"xarray data: no variable {name}; see wrf_mi.datasets.labelled for names and dimensions")
    observation = dataset["observation"]
    kind = "csi" if observation.dtype.kind == "c" else "rssi" if observation.ndim == 2 else "spectrum"
    task = task_named(str(dataset.attrs.get("task", kind)), "xarray data")
    if "tx_pos_m" not in dataset:
        rows = [dataset[axis].to_numpy() for axis in "xyz"]
        dataset = dataset.assign(tx_pos_m=(("row", "axis"), np.stack(rows, axis=-1)))
    arrays: dict[str, Any] = {}
    for name in map(str, dataset.data_vars):
        if name in OF_RECEIVERS:
            dims = (*PAIR, *_observed(task, dataset[name].ndim))
            arrays[name] = ordered(dataset[name], "receiver", *(dim for dim in dims if dim != "receiver"))
        elif name in DIMENSIONS:
            arrays[name] = ordered(dataset[name], *DIMENSIONS[name])
        elif name == "frequencies_hz":
            arrays[name] = dataset[name].to_numpy()
    labels = dataset["receiver"].values if "receiver" in dataset.coords else range(dataset.sizes["receiver"])
    unknown = [Receiver(str(name), np.full(3, np.nan), np.array(UPRIGHT)) for name in labels]
    arrays = {**receiver_arrays(unknown), "tx_antenna": np.array(astuple(ANTENNA)), **arrays}
    return record_from_arrays(arrays, str(dataset.attrs.get("name", "xarray")), task.name)


@dataclass(frozen=True)
class LabelledPrediction(Prediction):
    """Predictions with the positions and receivers that they are of.

    Attributes:
        tx_pos_m: positions [m, 3], metres.
        receiver_names: names of the receivers; of one ``mean`` is [m, ...], of several [n_rx, m, ...].
        task: task of the data.
        of_one: whether ``mean`` is of one receiver, without an axis of receivers.
    """

    tx_pos_m: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    receiver_names: tuple[str, ...] = ()
    task: str = ""
    of_one: bool = False

    def to_xarray(self) -> xarray.Dataset:
        """Dataset of ``prediction`` (row, receiver, ...), ``tx_pos_m`` and stated ``std``, ``std_mean``, ``reception``.

        `InputError`: xarray is not installed.
        """
        arrays = {"prediction": self.mean, "std": self.std, "std_mean": self.std_mean}
        predicted = {
            name: values[None] if self.of_one else values for name, values in arrays.items() if values is not None
        }
        task = TASKS[self.task]
        variables: dict[str, Any] = {name: _variable(name, values, task) for name, values in predicted.items()}
        if self.reception is not None:
            variables["reception"] = PAIR, (self.reception[None] if self.of_one else self.reception).T
        variables["tx_pos_m"] = _variable("tx_pos_m", self.tx_pos_m, task)
        labels = _labels(self.receiver_names, task, predicted["prediction"].shape)
        return xarray_package().Dataset(variables, labels, {"task": self.task})
