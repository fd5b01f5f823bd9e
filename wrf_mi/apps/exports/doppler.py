"""Channels over time and delay-Doppler spectra of a track, as arrays and as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...core import InputError
from ...core.array_files import write_arrays
from ...core.carriers import carriers_text
from ...core.files import write_figure
from ...receivers import Sampling, csi_over_time, delay_doppler_spectrum
from .format import ExportOptions
from .paths_table import traced_paths
from .source import Source

BANDWIDTH_HZ = 100e6
MOST_DRAWN = 4  # receivers in the picture
RANGE_DB = 40.0  # range of the picture below the strongest value


def write_doppler(source: Source, out: Path, options: ExportOptions) -> dict[str, Any]:
    """Write channels over time and delay-Doppler spectra of a run or a scene (`wrf_mi.apps.exports.source.Write`).

    The ``.npz`` has ``channel`` [n_rx, rows, times, subcarriers], ``delay_doppler`` [n_rx, rows, delays, Doppler
    shifts] (power), the axes ``time_s``, ``frequency_hz``, ``delay_s`` and ``doppler_hz``, and ``tx_pos`` and
    ``receiver_name``. A picture of the same name, ``.png``, is beside it. `InputError`: no path, paths of several
    carriers, or nothing that moves.
    """
    traced = traced_paths(source, options)
    paths, carriers_hz = traced.paths, np.unique(traced.path_carriers_hz)
    if len(carriers_hz) != 1:
        text = (
            f"{carriers_text(carriers_hz)}; trace one carrier"
            if len(paths)
            else "no path from transmitters to receivers"
        )
        raise InputError(f"{source.name}: {text}")
    if not paths.length_rate_mps.any():
        text = "nothing moves; give vx,vy,vz or t in --tx or --rx, or in the data's tx_pos.csv, or edit --velocity"
        raise InputError(f"{source.name}: {text}")
    bandwidth_hz = BANDWIDTH_HZ if options.bandwidth_hz is None else options.bandwidth_hz
    sampling = Sampling.of_paths(paths, float(carriers_hz[0]), bandwidth_hz)
    channel = csi_over_time(paths, sampling)
    spectrum, names = delay_doppler_spectrum(channel), [receiver.name for receiver in traced.receivers]
    arrays: dict[str, Any] = {"channel": channel, "delay_doppler": spectrum, "time_s": sampling.times_s}
    arrays |= {"frequency_hz": sampling.frequencies_hz, "delay_s": sampling.delays_s}
    arrays |= {"doppler_hz": sampling.dopplers_hz, "tx_pos": traced.tx_pos_m, "receiver_name": np.array(names)}
    write_arrays(out, arrays)
    picture = write_figure(out.with_suffix(".png"), _figure(spectrum, sampling, names))
    shifts_hz = paths.doppler_hz(carriers_hz[0])
    facts = {
        "rows": paths.n_tx,
        "receivers": paths.n_rx,
        "delays": spectrum.shape[2],
        "Doppler shifts": spectrum.shape[3],
    }
    return facts | {"shifts of paths (Hz)": f"{shifts_hz.min():.4g} to {shifts_hz.max():.4g}", "picture": str(picture)}


def _figure(spectrum: NDArray[np.float32], sampling: Sampling, names: list[str]) -> Figure:
    """Doppler spectrum of each row, and delay-Doppler spectrum of the mean over rows, of the first receivers."""
    drawn = min(len(names), MOST_DRAWN)
    figure = Figure(figsize=(9, 3.2 * drawn), layout="constrained", facecolor="white")
    delays_ns, dopplers_hz = 1e9 * sampling.delays_s, sampling.dopplers_hz
    for panels, name, power in zip(figure.subplots(drawn, 2, squeeze=False), names, spectrum[:drawn], strict=False):
        numbers = np.arange(1, len(power) + 1)
        over_rows, mean = power.sum(axis=1), power.mean(axis=0)
        used = int(np.flatnonzero(mean.max(axis=1) > mean.max() * 10 ** (-RANGE_DB / 10)).max(initial=0)) + 2
        for axes, values, down, label, what in (
            (panels[0], over_rows, numbers, "row", "each row"),
            (panels[1], mean[:used], delays_ns[:used], "delay (ns)", "mean over rows"),
        ):
            decibel = 10 * np.log10(np.maximum(values, np.finfo(np.float32).tiny))
            shade = {"vmax": decibel.max(), "vmin": decibel.max() - RANGE_DB, "cmap": "viridis", "shading": "nearest"}
            image = axes.pcolormesh(dopplers_hz, down, decibel, rasterized=True, **shade)
            axes.set(xlabel="Doppler shift (Hz)", ylabel=label, title=f"{name[:40]}, {what}")
            figure.colorbar(image, ax=axes).set_label("power (dB)")
    return figure
