"""Measured antenna patterns of a record: what each file states, and pictures of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core import Antenna, Record
from ...core.angles import FloatArray, unit_vectors
from ...core.carriers import carriers_text
from ...core.files import listed, write_figure

OTHER_BAND = 0.1  # relative difference of frequencies beyond which a pattern is that of another band
FLOOR_DB = 30.0  # range of gains that is drawn


def measured_antennas(record: Record) -> dict[Antenna, list[str]]:
    """Names of the devices of each measured pattern, frames aside."""
    antennas: dict[Antenna, list[str]] = {}
    devices = [(receiver.name, receiver.antenna) for receiver in record.receivers]
    for name, antenna in [*devices, ("transmitter", record.tx_antenna)]:
        if antenna.measured is not None:
            antennas.setdefault(antenna, []).append(name)
    return antennas


def antenna_notes(record: Record) -> list[str]:
    """Notes about measured patterns: largest gain and its direction, efficiency, and whether the band is another."""
    notes = []
    stated = (record.receiver_carriers_hz, record.carriers_hz, record.frequencies_hz)
    carriers_hz = next((np.asarray(hz) for hz in stated if hz is not None), np.zeros(0))
    for antenna, names in measured_antennas(record).items():
        measured, text = (
            antenna.measured,
            f"antenna {Path(antenna.pattern).name} of {listed(names)}: {antenna.measured}",
        )
        assert measured is not None
        hz = measured.frequency_hz
        if hz is not None and (np.abs(carriers_hz / hz - 1) > OTHER_BAND).any():
            text += f", but {carriers_text(carriers_hz)}"
        notes.append(text)
    return notes


def draw_antennas(record: Record, folder: Path) -> list[Path]:
    """Draw the gain of each measured pattern into PNG files: over all directions, and the two principal cuts.

    Angles are those of the antenna's frame: azimuth from the boresight to the left, elevation upwards.
    """
    from matplotlib.figure import Figure  # takes a second, which a check without pictures does not need

    files = []
    for number, (antenna, names) in enumerate(measured_antennas(record).items()):
        assert antenna.measured is not None
        figure, peak = Figure(figsize=(12, 4.5), layout="constrained"), antenna.measured.peak_dbi
        figure.suptitle(f"{Path(antenna.pattern).name} of {listed(names)}: {antenna.measured}", fontsize="medium")
        plane = figure.add_subplot(131)
        angles_deg = np.linspace(-180, 180, 361), np.linspace(-90, 90, 181)
        gain_db = np.maximum(_gains_db(antenna, angles_deg[0], angles_deg[1][:, None]), peak - FLOOR_DB)
        shades = plane.pcolormesh(*angles_deg, gain_db, shading="nearest")
        plane.set(xlabel="azimuth [deg]", ylabel="elevation [deg]", xticks=range(180, -181, -90), xlim=(180, -180))
        figure.colorbar(shades, ax=plane, label="gain [dBi]", location="bottom")
        turn = np.arange(361.0)  # elevations beyond 90 degrees go on behind the antenna
        for number_of_cut, (name, *angles) in enumerate((("horizontal", turn, 0 * turn), ("vertical", 0 * turn, turn))):
            axes = figure.add_subplot(1, 3, 2 + number_of_cut, projection="polar")
            axes.plot(np.radians(turn), np.maximum(_gains_db(antenna, *angles), peak - FLOOR_DB))
            axes.set(title=f"{name} cut [dBi]", ylim=(peak - FLOOR_DB, peak + 1))
        files.append(write_figure(folder / f"antenna{number}-{Path(antenna.pattern).stem}.png", figure))
    return files


def _gains_db(antenna: Antenna, azimuth_deg: FloatArray, elevation_deg: FloatArray) -> FloatArray:
    """Gains in dBi of directions whose angles broadcast."""
    field = antenna.field(unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg)))
    return np.asarray(20 * np.log10(np.maximum(np.linalg.norm(field, axis=-1), 1e-6)))
