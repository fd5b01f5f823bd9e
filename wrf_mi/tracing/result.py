"""A trace: paths with all that gains for other materials or antennas need, and the file that keeps them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ..core import Antenna, InputError, Paths, Receiver, receiver_arrays, stored_receivers
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..core.paths import read_paths_file, save_paths
from .buffer import Legs, join
from .fields import Devices, Ends, path_gains, scattering_materials
from .options import TraceOptions
from .surfaces import Surfaces, scene_surfaces


@dataclass(frozen=True)
class TraceResult:
    """Paths and how they were found.

    Attributes:
        paths: the paths, p of them.
        tx_pos_m: transmitters [n_tx, 3], metres.
        receivers: the ``n_rx`` receivers.
        primitives: triangle of the object at each interaction, int32, shape [p, depth], -1 beyond the last.
        probability: see `wrf_mi.tracing.buffer.Legs`.
        wedge: see `wrf_mi.tracing.buffer.Legs`; empty without diffraction.
        options: as asked for.
        rays: that searched from each source; differs from ``options.rays`` where that is ``"auto"``.
        from_receivers: the search went from receivers to transmitters.
        frequency_hz: of the carrier at which they were searched for.
        tx_antenna: antenna of the transmitters.
        carriers_hz: carrier of each transmitter [n_tx], of which the gains are; None: ``frequency_hz``.
    """

    paths: Paths
    tx_pos_m: FloatArray
    receivers: tuple[Receiver, ...]
    primitives: NDArray[np.int32]
    probability: NDArray[np.float32]
    wedge: dict[str, NDArray[Any]]
    options: TraceOptions
    rays: int
    from_receivers: bool
    frequency_hz: float
    tx_antenna: Antenna = ANTENNA
    carriers_hz: FloatArray | None = None

    def select(self, which: NDArray[Any]) -> TraceResult:
        """The paths of a mask or of ascending indices ``which`` [p], of the same devices."""
        wedge = {name: values[which] for name, values in self.wedge.items()}
        kept = self.primitives[which], self.probability[which]
        return replace(self, paths=self.paths.select(which), primitives=kept[0], probability=kept[1], wedge=wedge)

    def without_faint(self, share: float) -> TraceResult:
        """The paths without the weakest of each transmitter at each receiver.

        Args:
            share: amplitudes of those that are left out add up to less than this share of the amplitudes of all,
                which bounds the error of a sum of the paths, whatever their phases.
        """
        pair, amplitude = self.paths.tx + self.paths.n_tx * self.paths.rx, np.abs(self.paths.gain)
        order = np.lexsort((amplitude, pair))
        ordered, upto = pair[order], np.cumsum(amplitude[order])
        first = np.searchsorted(ordered, ordered)
        upto -= (upto - amplitude[order])[first]
        kept = np.empty(len(pair), bool)
        kept[order] = upto >= share * np.bincount(pair, amplitude)[ordered]
        return self.select(kept)

    def legs(self, surfaces: Surfaces) -> Legs:
        """The paths in the direction of the search, for Sionna RT.

        Raises:
            InputError: the scene lacks an object, or has another one by that name.
        """
        paths, first = self.paths, np.zeros(len(self.paths.object_names), np.int64)
        for index, name in enumerate(paths.object_names):
            own = paths.objects == index
            if not own.any():
                continue
            if name not in surfaces.names:
                raise InputError(f"scene: no object {name!r}, which the saved paths meet; open the scene they are of")
            place = surfaces.names.index(name)
            first[index] = surfaces.first_face[place]
            if self.primitives[own].max() >= surfaces.first_face[place + 1] - first[index]:
                raise InputError(f"scene: object {name!r} is not the one that the saved paths meet; trace them anew")
        face = np.where(paths.objects >= 0, first[paths.objects] + self.primitives, -1)
        legs = Legs(paths.tx, paths.rx, paths.interactions, face, paths.vertices_m, self.probability, self.wedge)
        return legs.reverse() if self.from_receivers else legs

    def ends(self) -> Ends:
        """Sources and targets, in the direction of the search."""
        transmitters, receivers = device_ends(self.tx_pos_m, self.receivers, self.tx_antenna)
        return (receivers, transmitters) if self.from_receivers else (transmitters, receivers)


def device_ends(tx_pos_m: FloatArray, receivers: tuple[Receiver, ...], tx_antenna: Antenna) -> Ends:
    """Transmitters and receivers as Sionna RT's devices."""
    antennas = tuple(one.antenna.mounted(one.orientation_xyzw) for one in receivers)
    rx = np.stack([receiver.position_m for receiver in receivers])
    return Devices(tx_pos_m, (tx_antenna.mounted(),)), Devices(rx, antennas)


def recompute(
    traced: TraceResult,
    scene: Any,
    *,
    rx_antennas: Sequence[Antenna] | None = None,
    tx_antenna: Antenna | None = None,
) -> TraceResult:
    """Gains of the same paths with the scene's present materials (and frequency), without tracing again.

    Args:
        traced: from `wrf_mi.tracing.trace_paths` or `load_trace`.
        scene: a ``sionna.rt.Scene`` of the same geometry.
        rx_antennas: other antennas of the receivers, one for each; None: those that were traced with.
        tx_antenna: another antenna of the transmitters; None: the one that was traced with.

    Returns:
        The same paths with other gains.

    Raises:
        InputError: the scene lacks an object that a path meets.
    """
    if rx_antennas is not None:
        own = (replace(one, antenna=a) for one, a in zip(traced.receivers, rx_antennas, strict=True))
        traced = replace(traced, receivers=tuple(own))
    if tx_antenna is not None:
        traced = replace(traced, tx_antenna=tx_antenna)
    surfaces = scene_surfaces(scene)
    with scattering_materials(scene, traced.options):
        gain = path_gains(scene, surfaces, traced.legs(surfaces), traced.ends(), traced.rays)
    paths, hz = replace(traced.paths, gain=gain), float(scene.frequency[0])
    return replace(traced, paths=paths, frequency_hz=hz, carriers_hz=None)


def join_traces(parts: Sequence[TraceResult]) -> TraceResult:
    """The trace of all transmitters from traces of consecutive ones, with the same receivers, scene and options."""
    first = parts[0]
    starts = np.cumsum([0, *(part.paths.n_tx for part in parts)])
    tx = np.concatenate([part.paths.tx + start for part, start in zip(parts, starts[:-1], strict=True)])
    # Stable: the paths of a pair of devices all come from one part and keep their order.
    order = np.lexsort((tx, np.concatenate([part.paths.rx for part in parts])))
    legs = [
        Legs(
            p.paths.tx,
            p.paths.rx,
            p.paths.interactions,
            p.primitives.astype(np.int64),
            p.paths.vertices_m,
            p.probability,
            p.wedge,
        )
        for p in parts
    ]
    joined = join(legs, first.primitives.shape[1]).select(order)
    carriers = None if first.carriers_hz is None else np.concatenate([cast(FloatArray, p.carriers_hz) for p in parts])
    names = ("rx", "gain", "length_m", "departure", "arrival", "interactions", "vertices_m", "objects")
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part.paths, name) for part in parts])[order] for name in names
    }
    paths = replace(first.paths, tx=tx[order], n_tx=int(starts[-1]), **arrays)
    return replace(
        first,
        paths=paths,
        tx_pos_m=np.concatenate([part.tx_pos_m for part in parts]),
        primitives=joined.face.astype(np.int32),
        probability=joined.probability,
        wedge=joined.wedge,
        carriers_hz=carriers,
    )


def save_trace(file: str | Path, traced: TraceResult) -> Path:
    """Write to an ``.npz`` of plain arrays that `wrf_mi.core.load_paths` reads too."""
    extra = {
        "tx_pos_m": traced.tx_pos_m,
        **receiver_arrays(traced.receivers),
        "primitives": traced.primitives,
        "probability": traced.probability,
        "options": json.dumps(asdict(traced.options)),
        "rays": traced.rays,
        "from_receivers": traced.from_receivers,
        "frequency_hz": traced.frequency_hz,
        "tx_antenna": np.array(astuple(traced.tx_antenna)),
        **({} if traced.carriers_hz is None else {"carriers_hz": traced.carriers_hz}),
    }
    return save_paths(file, traced.paths, extra | {f"wedge/{name}": values for name, values in traced.wedge.items()})


def load_trace(file: str | Path) -> TraceResult:
    """Read what `save_trace` wrote.

    Raises:
        InputError: missing, damaged, or without what tells how the paths were traced.
    """
    paths, extra = read_paths_file(file)
    try:
        return TraceResult(
            paths,
            extra["tx_pos_m"],
            stored_receivers(extra),
            extra["primitives"],
            extra["probability"],
            {key.removeprefix("wedge/"): values for key, values in extra.items() if key.startswith("wedge/")},
            TraceOptions(**json.loads(str(extra["options"]))),
            int(extra["rays"]),
            bool(extra["from_receivers"]),
            float(extra["frequency_hz"]),
            Antenna(*map(str, extra["tx_antenna"])),
            extra.get("carriers_hz"),
        )
    except (KeyError, ValueError, TypeError) as error:
        raise InputError(f"{file}: holds paths alone, not how they were traced ({error}); trace them anew") from None
