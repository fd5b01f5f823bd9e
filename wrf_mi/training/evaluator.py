"""Evaluation of a graph's observations for transmitters whose paths are known: splatted, traced, or by operator.

- `SplattedObservations`: Gaussians alone, as one recorded function.
- `TracedObservations`: with the paths of a scene, or Gaussians that are traced.
- `OperatorObservations`: Gaussians of static geometry, as a linear map from their signals to pixels.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ..backend.device import Recorded, to_tensor
from ..backend.vectors import Complex
from ..core.angles import FloatArray
from ..core.array_files import stored_arrays, write_arrays
from ..core.digest import content_digest
from ..core.types import IntArray
from ..gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M
from ..gaussians.operator import Images, PixelOperator, pixel_weights, static_signals
from ..gaussians.parameters import CHUNK_SIZE
from ..gaussians.tiles import perception_plane
from ..graph.graph import Batch, Component, Field, Graph
from ..receivers.registry import PIXEL
from ..receivers.scaling import SQUARED_MAGNITUDE_EPS
from ..tracing.paths.traced_field import TracedField
from ..version import __version__
from .adam import Params
from .step import batch_on_device, device_pose, evaluated, port_batches

TOGETHER = 16  # transmitters whose Gaussians, or paths and Gaussians, are evaluated in one batch
TRACED_NUMBERS = 512  # with paths, numbers in a batch of small observations
FORMAT = 1  # version of the file of an operator
MOST_BYTES = 1 << 30  # largest size of one receiver's weights; larger fields are evaluated directly


@dataclass(frozen=True)
class Request:
    """Transmitters whose observations of one port are evaluated."""

    condition: FloatArray  # positions [m, 3], metres, or features [m, features]
    port: int  # number of the port
    traced_field: TracedField | None  # its traced field, or None
    slots: IntArray  # rows of the traced field [m]
    weight: NDArray[Any] | None = None  # weight of the Gaussians' signal [m], 0 to 1; None: 1
    component: Component | None = None  # the one component that is observed (`Graph.observation`); None: both
    phase_error: float = 0.0  # see `Graph.observation`

    def rows(self, rows: slice | IntArray) -> Request:
        """The request for some of the transmitters."""
        weight = None if self.weight is None else self.weight[rows]
        return replace(self, condition=self.condition[rows], slots=self.slots[rows], weight=weight)


class Evaluator(ABC):
    """Evaluates observations of a graph with one set of parameters, Dr.Jit tensors."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.params: Params = {}

    def update(self, params: Params) -> None:
        """Replace the parameters (Dr.Jit tensors)."""
        self.params = params

    @abstractmethod
    def __call__(self, request: Request) -> NDArray[np.float32]:
        """Observations [m, *shape of an observation]."""


class _InBatches(Evaluator):
    """Evaluates batches of transmitters by functions of Dr.Jit, recorded where it can record them."""

    def __init__(self, graph: Graph) -> None:
        super().__init__(graph)
        self._batches, self._count = port_batches(graph), 0
        self.recordings: dict[tuple[Hashable, int], Recorded] = {}  # by names and numbers of transmitters

    def update(self, params: Params) -> None:
        """Replace the parameters (Dr.Jit tensors)."""
        count = params["position"].shape[1] if "position" in params else 0
        if count != self._count:
            # The number of Gaussians is a constant of a recording.
            self._count, self.recordings = count, {}
        super().update(params)

    def __call__(self, request: Request) -> NDArray[np.float32]:
        """Observations [m, *shape of an observation], batch by batch."""
        shape, count = self.graph.models[request.port].shape, len(request.condition)
        if self.graph.form.features:  # of one antenna of the array
            shape = shape[-2:]
        out, size = np.empty((count, *shape), np.float32), self._batch_size(math.prod(shape))
        for start in range(0, count, size):
            part = slice(start, min(start + size, count))
            out[part] = self._evaluated(request.rows(part)).numpy().reshape(part.stop - part.start, *shape)
        return out

    @abstractmethod
    def _batch_size(self, numbers: int) -> int:
        """Largest number of transmitters in a batch, for observations of so many numbers."""

    @abstractmethod
    def _evaluated(self, request: Request) -> Any:
        """Flat observations of a batch, a Dr.Jit array."""

    def _batch(self, request: Request, signal: Complex | None = None) -> Batch:
        """The transmitters of a request on the device, with the Gaussians' signal, if that is evaluated already."""
        port_batch = self._batches[request.port]
        return batch_on_device(port_batch, request.condition.T, request.slots, request.weight, signal)

    def _may_record(self, size: int) -> bool:
        # Networks of a recorded function are not evaluated in chunks, and lists of tiles, which it cannot count, have
        # room for all: neither is for very many Gaussians.
        return self.graph.evaluation.recordable and self._count * size <= CHUNK_SIZE

    def _recorded(
        self,
        name: Hashable,
        size: int,
        function: Callable[[Mapping[str, Any], Batch], Any],
        request: Request,
        read: Callable[[], Any] | None = None,
    ) -> Any:
        """Evaluate a function of at most ``size`` transmitters, which Dr.Jit records at its first call by a name.

        ``read`` returns the arrays that the function reads beside its arguments.
        """
        count = len(request.condition)
        if (name, size) not in self.recordings:

            def recordable(params: Params, batch: Batch) -> Any:
                with dr.suspend_grad():
                    return function(params, batch)

            # Arrays that are made from NumPy's memory at first use must exist before a recording.
            evaluated(function, self.params, self._batch(request.rows(slice(1))))
            self.recordings[name, size] = Recorded(recordable, read)
        # The number of transmitters is a constant of the recorded kernels: copies of the last one fill a batch.
        batch = self._batch(request.rows(np.minimum(np.arange(size), count - 1)))
        arrays = self.recordings[name, size](self.params, batch)

        def leading(values: Any) -> Any:
            return dr.gather(type(values), values, dr.arange(mi.UInt32, count * (dr.width(values) // size)))

        if count == size:
            return arrays
        return tuple(map(leading, arrays)) if isinstance(arrays, tuple) else leading(arrays)


class SplattedObservations(_InBatches):
    """Observations of Gaussians alone, splatted."""

    def _batch_size(self, numbers: int) -> int:
        # An image of thousands of pixels fills the processors, and one recording serves any number of transmitters.
        return 1 if self.graph.form.receiver == PIXEL else TOGETHER

    def _evaluated(self, request: Request) -> Any:
        size, port = self._batch_size(1), request.port
        if not self._may_record(size):
            return evaluated(self.graph.observation(port, None, chunked=True), self.params, self._batch(request))
        # One recording serves the pixels of all ports, whose poses are arguments.
        name, read = ("observation", None if size == 1 else port), partial(self.graph.arrays, port, None)
        return self._recorded(name, size, self.graph.observation(port, None), request, read)


class TracedObservations(_InBatches):
    """Observations with the paths of a scene, or of Gaussians that are traced."""

    def __init__(self, graph: Graph) -> None:
        super().__init__(graph)
        self._traced_fields: dict[Hashable, TracedField] = {}

    def _batch_size(self, numbers: int) -> int:
        return max(TOGETHER, TRACED_NUMBERS // numbers)

    def _evaluated(self, request: Request) -> Any:
        port, traced_field = request.port, request.traced_field
        # Gaussians are not evaluated beside paths where none has a weight.
        learned = self.graph.field is not None and request.component != "traced"
        learned = learned and (traced_field is None or request.weight is None or bool(np.any(request.weight)))
        if traced_field is not None and len(traced_field) == 1 and self._may_record(1):
            return self._of_one(request, traced_field, learned)
        # Numbers of paths differ from batch to batch, and a recording serves one: only the Gaussians' signal, which
        # takes most of the time, is recorded.
        signal, count = None, len(request.condition)
        # Batches of `TOGETHER` are recorded; copies that filled others would cost more than they save.
        if learned and TOGETHER // 2 < count <= TOGETHER and self._may_record(TOGETHER):
            # One recording serves the poses of all receivers unless they are trained.
            name = "signal", port if self.graph.moves else None
            signal = self._recorded(name, TOGETHER, partial(self.graph.learned, port), replace(request, weight=None))
        observe = self.graph.observation(
            port, traced_field, learned, component=request.component, phase_error=request.phase_error
        )
        return evaluated(observe, self.params, self._batch(request, signal))

    def _of_one(self, request: Request, traced_field: TracedField, learned: bool) -> Any:
        """Observation of one transmitter, by a recording that serves others, whose traced fields are inputs."""
        port, how = request.port, {"component": request.component, "phase_error": request.phase_error}
        name = "both", port, learned, *how.values(), traced_field.form
        # The recorded function looks the traced field up at each call, as its arrays are read beside the arguments.
        self._traced_fields[name] = traced_field

        def observe(params: Mapping[str, Any], batch: Batch) -> Any:
            return self.graph.observation(port, self._traced_fields[name], learned, **how)(params, batch)  # type: ignore[arg-type]

        return self._recorded(name, 1, observe, request, lambda: self.graph.arrays(port, self._traced_fields[name]))


class OperatorObservations(Evaluator):
    """Magnitudes at each direction by the linear map from signals to pixels (`wrf_mi.gaussians.operator`).

        operator<r>.npz    of receiver r: format version, key, weights [pixels, n] as a sparse matrix; arrays only

    The file, in the folder ``store`` unless that is None, is a cache: its key is a digest of all that weights depend
    on, including the package's version. Geometry and attenuation of Gaussians must not depend on the transmitter.
    """

    def __init__(self, graph: Graph, store: Path | None) -> None:
        super().__init__(graph)
        self._store, self._field = store, cast(Field, graph.field)
        self._ready: dict[int, Images | PixelOperator] = {}

    def update(self, params: Params) -> None:
        """Replace the parameters; operators are built anew at the next prediction."""
        super().update(params)
        self._arrays = {name: dr.detach(values).numpy() for name, values in params.items()}
        self._signals, self._ready = static_signals(self._field, self._arrays), {}

    def __call__(self, request: Request) -> NDArray[np.float32]:
        """Magnitudes [m, height, width] (MemoryError: weights of more than `MOST_BYTES`)."""
        receiver, (factors, coefficients) = request.port, self._signals
        if receiver not in self._ready:
            operator = PixelOperator(self._weights(receiver), *self.graph.form.size)
            self._ready[receiver] = operator if factors is None else operator.composed(factors)
        return self._ready[receiver].magnitude(
            coefficients(np.asarray(request.condition, np.float32)), SQUARED_MAGNITUDE_EPS
        )

    def key(self, receiver: int) -> str:
        """Digest of everything that the weights at a receiver depend on."""
        pose, size = self.graph.receivers[receiver], self.graph.form.size
        constants = (FORMAT, __version__, *size, CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M, repr(self._field))
        # Another signal network leaves the weights as they are.
        signal_alone = self._field.signal_parameters
        arrays = {name: values for name, values in self._arrays.items() if not name.startswith(signal_alone)}
        return content_digest(constants, pose.position_m, pose.to_world, arrays)

    def _weights(self, receiver: int) -> csr_array:
        """Weights [pixels, n] at a receiver: stored ones if they are valid, else built and stored."""
        key, size = self.key(receiver), self.graph.form.size
        path = None if self._store is None else self._store / f"operator{receiver}.npz"
        if path is not None:
            stored = read_weights(path, key, (size[0] * size[1], self.params["position"].shape[1]))
            if stored is not None:
                return stored
        with dr.suspend_grad():
            # Of any transmitter: geometry and attenuation are those of all.
            gaussians = self._field.gaussians(self.params, to_tensor(np.zeros((3, 1))))
            pose, plane = device_pose(self.graph.receivers[receiver]), perception_plane(*size, mi.Float)
            weights = pixel_weights(gaussians, pose, plane, MOST_BYTES)
        if path is not None:
            parts = {name: getattr(weights, name) for name in ("data", "indices", "indptr")}
            with suppress(OSError):  # a run in a folder of someone else is predicted all the same
                write_arrays(path, {"format": np.asarray(FORMAT), "key": np.asarray(key)} | parts, checksum=True)
        return weights


def read_weights(path: Path, key: str, shape: tuple[int, int]) -> csr_array | None:
    """Stored weights of ``shape``; None if there are none, or if they are damaged or have another key."""
    try:
        stored = stored_arrays(path)
        if int(stored["format"]) != FORMAT or str(stored["key"]) != key:
            return None
        weights = csr_array(tuple(stored[name] for name in ("data", "indices", "indptr")), shape=shape)
        # SciPy's product checks nothing: an index out of range would end the process.
        weights.check_format(full_check=True)
    except Exception:  # numpy, zipfile and scipy raise a dozen kinds on damaged files
        return None
    return weights


def evaluator_of(graph: Graph, operator: bool = False, store: Path | None = None) -> Evaluator:
    """The evaluator of a graph; ``operator``: by operator where geometry and attenuation are static."""
    if graph.scene is not None or not graph.evaluation.recordable:
        return TracedObservations(graph)
    static = getattr(graph.field, "static_geometry", False) and graph.form.receiver == PIXEL
    if operator and static and graph.form.carriers_hz is None:
        return OperatorObservations(graph, store)
    return SplattedObservations(graph)
