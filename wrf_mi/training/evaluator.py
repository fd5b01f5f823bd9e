"""Evaluation of a graph's reports for transmitters whose paths are known: splatted, traced, or by operator.

- `SplattedReports`: Gaussians alone, as one recorded function.
- `TracedReports`: with the paths of a scene, or Gaussians that are traced.
- `OperatorReports`: Gaussians of static geometry, as a linear map from their signals to pixels.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_float, to_tensor
from ..backend.recorded import Recorded
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..gaussians.parameters import CHUNK_SIZE
from ..graph.graph import Alone, Batch, Graph, Report
from ..graph.receivers import PIXEL
from ..tracing.paths.traced_field import TracedField
from .adam import Params
from .static_operator import StaticOperator
from .step import evaluated, places_of

TOGETHER = 16
"""Transmitters whose Gaussians, or paths and Gaussians, are evaluated in one batch."""
TRACED_NUMBERS = 512
"""With paths, numbers in a batch of small observations."""


@dataclass(frozen=True)
class Request:
    """Transmitters whose reports of one port are evaluated.

    Attributes:
        condition: positions [m, 3], metres, or features [m, features].
        port: number of the port.
        side: its traced side, or None.
        slots: rows of the traced side [m].
        weight: weight of the Gaussians' signal [m], 0 to 1; None: 1.
        alone: component reported alone (`Graph.report`); None: both together.
        phase_error: see `Graph.report`.
    """

    condition: FloatArray
    port: int
    side: TracedField | None
    slots: IntArray
    weight: NDArray[Any] | None = None
    alone: Alone | None = None
    phase_error: float = 0.0

    def rows(self, chosen: slice) -> Request:
        """The request for some of the transmitters."""
        weight = None if self.weight is None else self.weight[chosen]
        return replace(self, condition=self.condition[chosen], slots=self.slots[chosen], weight=weight)


class Evaluator(ABC):
    """Evaluates reports of a graph with one set of parameters.

    Args:
        graph: Gaussians, paths and receivers.

    Attributes:
        params: parameters, Dr.Jit tensors.
    """

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.params: Params = {}

    def update(self, params: Params) -> None:
        """Replace the parameters (Dr.Jit tensors)."""
        self.params = params

    @abstractmethod
    def __call__(self, request: Request) -> NDArray[np.float32]:
        """Reports [m, *shape of a report]."""


class _InBatches(Evaluator):
    """Evaluates batches of transmitters by functions of Dr.Jit, recorded where it can record them.

    Attributes:
        recordings: recorded functions by their names and numbers of transmitters.
    """

    def __init__(self, graph: Graph) -> None:
        super().__init__(graph)
        self._places, self._count = places_of(graph), 0
        self.recordings: dict[tuple[Hashable, int], Recorded] = {}

    def update(self, params: Params) -> None:
        """Replace the parameters (Dr.Jit tensors)."""
        count = params["position"].shape[1] if "position" in params else 0
        if count != self._count:
            # The number of Gaussians is a constant of a recording.
            self._count, self.recordings = count, {}
        super().update(params)

    def __call__(self, request: Request) -> NDArray[np.float32]:
        """Reports [m, *shape of a report], batch by batch."""
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
        """Largest number of transmitters in a batch, for reports of so many numbers."""

    @abstractmethod
    def _evaluated(self, request: Request) -> Any:
        """Flat report of a batch, a Dr.Jit array."""

    def _plain(self, report: Report, request: Request, **signal: Any) -> Any:
        """A report that is not recorded."""
        place = self._places[request.port]
        return evaluated(report, self.params, request.condition.T, place, request.slots, request.weight, **signal)

    def _may_record(self, size: int) -> bool:
        """Whether functions of Gaussians are recorded for batches of a size.

        Networks of a recorded function are not evaluated in chunks, and lists of tiles, which it cannot count, have
        room for all: neither is for very many Gaussians.
        """
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
        condition, count, place = request.condition.T, len(request.condition), self._places[request.port]
        if (name, size) not in self.recordings:

            def recordable(params: Params, batch: Batch) -> Any:
                with dr.suspend_grad():
                    return function(params, batch)

            # Arrays that are made from NumPy's memory at first use must exist before a recording.
            evaluated(function, self.params, condition[:, :1], place)
            self.recordings[name, size] = Recorded(recordable, read)
        # The number of transmitters is a constant of the recorded kernels: copies of the last one fill a batch.
        filled = np.minimum(np.arange(size), count - 1)
        tx, slots = to_tensor(np.ascontiguousarray(condition[:, filled])), dr.zeros(mi.UInt32, size)
        dr.make_opaque(slots)
        weight = None if request.weight is None else to_float(request.weight[filled])
        arrays = self.recordings[name, size](self.params, place.batch(tx, slots, weight))

        def leading(values: Any) -> Any:
            return dr.gather(type(values), values, dr.arange(mi.UInt32, count * (dr.width(values) // size)))

        if count == size:
            return arrays
        return tuple(map(leading, arrays)) if isinstance(arrays, tuple) else leading(arrays)


class SplattedReports(_InBatches):
    """Reports of Gaussians alone, splatted."""

    @property
    def _pixels(self) -> bool:
        return self.graph.form.receiver == PIXEL

    def _batch_size(self, numbers: int) -> int:
        # An image of thousands of pixels fills the processors, and one recording serves any number of transmitters.
        return 1 if self._pixels else TOGETHER

    def _evaluated(self, request: Request) -> Any:
        size, port = self._batch_size(1), request.port
        if not self._may_record(size):
            return self._plain(self.graph.report(port, None, chunked=True), request)
        # One recording serves the pixels of all ports, whose poses are arguments.
        name = "report", None if self._pixels else port
        return self._recorded(
            name, size, self.graph.report(port, None), request, partial(self.graph.arrays, port, None)
        )


class TracedReports(_InBatches):
    """Reports with the paths of a scene, or of Gaussians that are traced."""

    def __init__(self, graph: Graph) -> None:
        super().__init__(graph)
        self._sides: dict[Hashable, TracedField] = {}

    def _batch_size(self, numbers: int) -> int:
        return max(TOGETHER, TRACED_NUMBERS // numbers)

    def _evaluated(self, request: Request) -> Any:
        """Paths alone where no Gaussian has a weight."""
        port, side, weight = request.port, request.side, request.weight
        learned = self.graph.field is not None and request.alone != "traced"
        learned &= side is None or weight is None or bool(np.any(weight))
        if side is not None and len(side) == 1 and self._may_record(1):
            return self._of_one(request, side, learned)
        signal, count = None, len(request.condition)
        # Batches of `TOGETHER` are recorded; copies that filled others would cost more than they save.
        if learned and TOGETHER // 2 < count <= TOGETHER and self._may_record(TOGETHER):
            # One recording serves the poses of all receivers unless they are trained.
            name = "signal", port if self.graph.moves else None
            signal = self._recorded(name, TOGETHER, partial(self.graph.learned, port), replace(request, weight=None))
        report = self.graph.report(port, side, learned, alone=request.alone, phase_error=request.phase_error)
        return self._plain(report, request, signal=signal)

    def _of_one(self, request: Request, side: TracedField, learned: bool) -> Any:
        """Report of one transmitter, by a recording that serves others, whose traced sides are inputs."""
        port, how = request.port, {"alone": request.alone, "phase_error": request.phase_error}
        name = "both", port, learned, *how.values(), side.form
        self._sides[name] = side

        def reported(params: Mapping[str, Any], batch: Batch) -> Any:
            return self.graph.report(port, self._sides[name], learned, **how)(params, batch)  # type: ignore[arg-type]

        return self._recorded(name, 1, reported, request, lambda: self.graph.arrays(port, self._sides[name]))


class OperatorReports(Evaluator):
    """Magnitudes at each direction by the linear map from signals to pixels (`wrf_mi.gaussians.operator`).

    Args:
        graph: Gaussians whose geometry and attenuation do not depend on the transmitter.
        store: folder in which operators are stored; None: in memory only.
    """

    def __init__(self, graph: Graph, store: Path | None) -> None:
        super().__init__(graph)
        self._store = store
        self.operator: StaticOperator | None = None

    def update(self, params: Params) -> None:
        """Replace the parameters; the operator is built anew at the next prediction."""
        super().update(params)
        self.operator = None

    def __call__(self, request: Request) -> NDArray[np.float32]:
        """Magnitudes [m, height, width].

        Raises:
            MemoryError: the operator is too large.
        """
        if self.operator is None:
            graph, params = self.graph, {name: dr.detach(values).numpy() for name, values in self.params.items()}
            assert graph.field is not None, "an operator needs Gaussians"
            self.operator = StaticOperator(graph.field, params, graph.receivers, *graph.form.size, self._store)
        return self.operator(np.asarray(request.condition, np.float32), request.port)


def evaluator_of(graph: Graph, operator: bool = False, store: Path | None = None) -> Evaluator:
    """The evaluator of a graph; ``operator``: by operator where geometry and attenuation are static."""
    if graph.scene is not None or not graph.evaluation.recordable:
        return TracedReports(graph)
    static = getattr(graph.field, "static_geometry", False) and graph.form.receiver == PIXEL
    if operator and static and graph.form.carriers_hz is None:
        return OperatorReports(graph, store)
    return SplattedReports(graph)
