"""Ray tracing, corrections, a published calibration and joint training against Maxwell's equations, solved by gprMax.

A vertical dipole and three receivers lie between two concrete walls, with a metal blocker in the line of sight, at
6 GHz; a twin of the scene has one wall a quarter of the wavelength off (arXiv 2312.12625, ``fdtd-toy``). The grid is a
slab of 83 cells between absorbing layers above, below and at the sides, so that waves spread in three dimensions:
amplitudes of single reflections fall as 1 / r, to 0.6 dB.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import epsilon_0, mu_0, speed_of_light
from scipy.optimize import minimize

import wrf_mi
from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.types import FloatArray, IntArray
from wrf_mi.correction import CorrectionOptions, write_page
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.path_lengths import lengths_and_slopes
from wrf_mi.correction.state import ScenePosterior, material_places
from wrf_mi.correction.uncertain_phases import UncertainPhases
from wrf_mi.datasets.registry import data_home
from wrf_mi.receivers.channel import rssi_dbm
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import CSI
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.options import TraceOptions
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.tracer import RayTracer

from .comparison import line, say
from .declared import lined
from .von_mises import calibrated

Complex = NDArray[np.complex128]
NAME, OUTPUT = "fdtd-toy", "toy_example_maxwell.out"
SOURCE = "github.com/kclip/phase-aware-rt-calibration, assets/"
CARRIER_HZ = 6e9
WAVELENGTH_M = speed_of_light / CARRIER_HZ
GRID_RAD = np.radians(56)  # angle between the grid's x axis and single reflections: 49 to 63 degrees
BAND_HZ = 3.5e9, 9e9  # frequencies at which the source radiates, and 14 cells or more fit into a wavelength
WIDE_HZ: FloatArray = CARRIER_HZ + np.linspace(-1e9, 1e9, 64)  # delays of all paths are resolved
NARROW_HZ: FloatArray = CARRIER_HZ + np.linspace(-945e3, 945e3, 64)  # 30 kHz apart, as published: no delay is resolved
BANDS: Mapping[str, FloatArray] = {"2 GHz": WIDE_HZ, "1.9 MHz": NARROW_HZ}
RECEIVERS = 20, 30, 40  # distances from the scene's centre along x, wavelengths; the transmitter is at -30
HEIGHT_M = 5.0  # of all devices: walls are 10 m high, and all paths are level
FITTED = slice(0, 2)  # receivers whose channels are known; the third is predicted
READINGS, SNR = 50, 1e3  # readings of each known channel, as published, and their signal-to-noise ratio
CONCRETE = {"relative_permittivity": 5.31, "conductivity": 0.139, "thickness": 2.0}
BRICK = {"relative_permittivity": 3.91, "conductivity": 0.0317, "thickness": 2.0}  # of ITU-R P.2040 at 6 GHz
"""So thick that nothing returns from the far side: gprMax's walls end in its absorbing layers."""
START = np.log([BRICK["relative_permittivity"] - 1, BRICK["conductivity"]])
WALLS = "upper_wall", "lower_wall"
OPTIONS = TraceOptions(transmission=True, depth=3, rays=1 << 16, seed=1)
TRAINED: Mapping[str, tuple[str, Mapping[str, float]]] = {
    "WRF-GS+, joint": ("wrf-gs+", {}),
    "WRF-GS+, joint, planes": ("wrf-gs+", {"traced.shift": 1e-3, "traced.tilt": 5e-4}),  # rates of `--calibrate planes`
    "hybrid": ("hybrid", {}),
}
"""Model and settings of fits in the twin with walls of brick."""
DIFFRACTED = TraceOptions(transmission=True, diffraction=True, depth=3, rays=1 << 16, seed=1)


def ricker(time_s: FloatArray) -> FloatArray:
    """Current of the source at times, as gprMax's waveform ``ricker`` of amplitude 1."""
    # gprMax documentation, "Built-in waveforms": zeta = (pi f)^2, centred at chi = sqrt(2) / f.
    square = (np.pi * CARRIER_HZ * (time_s - np.sqrt(2) / CARRIER_HZ)) ** 2
    return np.asarray((1 - 2 * square) * np.exp(-square))


def grid_wavenumber(frequency_hz: FloatArray, cell_m: float, step_s: float, angle_rad: float) -> FloatArray:
    """Wavenumber in a grid of cubic cells along a direction in its x-y plane, rad/m.

    Source: numerical dispersion relation of Yee's grid, Taflove and Hagness, "Computational Electrodynamics" (2005),
    equation 4.12, by Newton's method.
    """
    in_time = (np.sin(np.pi * frequency_hz * step_s) * cell_m / (speed_of_light * step_s)) ** 2
    wavenumber, parts = 2 * np.pi * frequency_hz / speed_of_light, (np.cos(angle_rad), np.sin(angle_rad))
    for _ in range(20):
        value = sum(np.sin(wavenumber * part * cell_m / 2) ** 2 for part in parts) - in_time
        slope = sum(np.sin(wavenumber * part * cell_m) * part * cell_m / 2 for part in parts)
        wavenumber = wavenumber - value / slope
    return wavenumber


def measured_channels(file: Path, frequencies_hz: FloatArray) -> Complex:
    """Channels [3, n] between isotropic vertical antennas at frequencies, from an output file of gprMax.

    The field of a dipole of current I and length l at the distance r is -j eta k I l exp(-j k r) / (4 pi r), with the
    vertical axis upwards (Balanis, "Antenna Theory", equation 4-26a), and the channel that of the tracer,
    wavelength / (4 pi r) exp(-j k r). In the grid, waves of 6 GHz are 0.07 to 0.28 % slower than light, 0.4 to 1.8 rad
    over 100 wavelengths. A frequency is therefore that at which free space has the grid's wavenumber, along single
    reflections.
    """
    import h5py

    with h5py.File(file) as stored:
        step_s, cell_m = float(stored.attrs["dt"]), float(stored.attrs["dx_dy_dz"][0])
        field = np.array([stored[f"rxs/rx{number}/Ez"][:] for number in (1, 2, 3)], float)
    count = 1 << int(np.ceil(np.log2(32 * field.shape[1])))  # so finely that linear interpolation serves
    hz = np.asarray(np.fft.rfftfreq(count, step_s), float)
    band = (hz > BAND_HZ[0]) & (hz < BAND_HZ[1])
    hz = hz[band]
    current = np.fft.rfft(ricker(step_s * np.arange(field.shape[1], dtype=float)), count)[band]
    impedance = np.sqrt(mu_0 / epsilon_0)
    of_dipole = -1j * impedance * (2 * np.pi * hz / speed_of_light) * current * cell_m / (4 * np.pi)
    channel = np.fft.rfft(field, count, axis=1)[:, band] / of_dipole * speed_of_light / hz / (4 * np.pi)
    grid_hz = grid_wavenumber(hz, cell_m, step_s, GRID_RAD) * speed_of_light / (2 * np.pi)
    return np.array([np.interp(frequencies_hz, grid_hz, row) for row in channel])


def toy_record(channels: Complex, frequencies_hz: FloatArray) -> tuple[Record, Split]:
    """`READINGS` readings of each channel [3, n] with noise, and a split that tests the third receiver.

    By reciprocity the receivers are the moving end.
    """
    positions = np.array([[distance * WAVELENGTH_M, 0, HEIGHT_M] for distance in RECEIVERS])
    station = Receiver("transmitter", np.array([-30 * WAVELENGTH_M, 0, HEIGHT_M]), np.array(UPRIGHT))
    truth, rng = np.repeat(channels, READINGS, axis=0), np.random.default_rng(1)
    deviation = np.sqrt(np.square(np.abs(truth)).mean(axis=1, keepdims=True) / (2 * SNR))
    noisy = truth + deviation * (rng.normal(size=truth.shape) + 1j * rng.normal(size=truth.shape))
    record = Record(
        NAME,
        CSI,
        np.repeat(positions, READINGS, axis=0),
        (station,),
        noisy[None].astype(np.complex64),
        frequencies_hz=frequencies_hz,
        truth=truth[None].astype(np.complex64),
    )
    rows: IntArray = np.arange(len(truth))
    is_training = rows < FITTED.stop * READINGS
    return record, Split("third-receiver", 0, rows[is_training], rows[:0], rows[~is_training])


def scene_of(model: Path, folder: Path, constants: Mapping[str, float]) -> Path:
    """A scene folder of the meshes of a scene of the data set, with walls of a material."""
    surfaces = []
    for name in (*WALLS, "blocker"):
        (mesh,) = mesh_parts(model / "meshes" / f"{name}.ply")
        surfaces.append(Surface(name, "other", np.asarray(mesh.vertices), np.asarray(mesh.faces)))
    materials = {WALLS[0]: "upper", WALLS[1]: "lower", "blocker": "perfect"}
    scene_materials = Materials(surfaces=materials, constants={"upper": constants, "lower": constants})
    return write_scene(
        folder, surfaces, frame="that of the data set", source=str(model), materials=scene_materials, replace=True
    )


def traced(scene: Path, record: Record, options: TraceOptions = OPTIONS) -> tuple[Complex, FloatArray]:
    """Channels [3, n] that ray tracing gives for the receivers, and sums of path powers [3], dB."""
    tracer = RayTracer(scene, Instrument("csi", record.receivers, WIDE_HZ), options)
    paths = tracer.trace(record.tx_pos_m[::READINGS])
    return np.asarray(tracer.observe(paths), complex)[0], rssi_dbm(paths.paths)[0]


def figures(channels: Complex, predicted: Complex, power_db: FloatArray) -> dict[str, Any]:
    """Energy of the error of predicted channels [3, n] relative to the measured ones', and error of powers, dB [3]."""
    power = np.square(np.abs(channels))
    return {
        "unexplained_db": (10 * np.log10(np.square(np.abs(predicted - channels)).sum(1) / power.sum(1))).tolist(),
        "power_db": (power_db - 10 * np.log10(power.mean(axis=1))).tolist(),
    }


class Twin:
    """Paths of the twin to the known receivers, whose channels materials of the walls and phases explain."""

    def __init__(self, scene: Path, record: Record, split: Split) -> None:
        prepared = Prepared(open_scene(scene, CARRIER_HZ))
        options = CorrectionOptions(("materials", "planes", "phases"))
        self.misfit = Misfit(record, split.train, prepared, options)
        self.posterior = ScenePosterior(self.misfit, options, lambda what, share: None)
        self._record, self._split = record, split

    def vector(self, logarithms: FloatArray) -> FloatArray:
        """Vector of the misfit with one material of both walls: logarithms of permittivity - 1 and conductivity."""
        vector = self.misfit.start.copy()
        for slab, name in enumerate(self.misfit.traced_fields[0].slabs.names):
            if name.startswith(WALLS):
                vector[material_places(self.misfit, slab)[:2]] = logarithms
        return vector

    def gaussian(self) -> FloatArray:
        """Logarithms as of `vector` by the likelihood of `wrf_mi.correction.uncertain_phases`."""
        fit = UncertainPhases(self.posterior)
        cost = minimize(lambda x: -float(fit.scores(self.vector(x)).sum()), START, method="Nelder-Mead")
        return np.asarray(cost.x)

    def published(self) -> FloatArray:
        """Logarithms as of `vector` by `wrf_mi_bench.von_mises`."""
        # Readings differ by noise alone: the first of each receiver, all of whose paths have phases of their own.
        paths, hz = self.misfit.paths, self._record.frequencies_hz
        assert hz is not None
        rows = np.arange(0, len(self._split.train), READINGS)
        length_m, _ = lengths_and_slopes(self.misfit, np.where(paths.reflects, paths.plane, -1), self.misfit.start)
        wave = np.exp(-2j * np.pi * length_m[:, None] * hz / speed_of_light)
        channels = self._record.observation[0, self._split.train[rows]].astype(complex)
        # In units of the mean square, so that the noise is 1 / SNR.
        unit = np.sqrt(np.square(np.abs(channels)).mean(axis=1))
        every = np.flatnonzero(np.isin(paths.row, rows))

        def waves_of(logarithms: FloatArray) -> list[Complex]:
            gain = self.misfit.gains(self.vector(logarithms), every)
            of_row = [paths.row[every] == row for row in rows]
            waves = [gain[which, None] * wave[every[which]] / size for which, size in zip(of_row, unit, strict=True)]
            # Paths through metal have no power, and so no phase.
            return [each[np.abs(each[:, 0]) > 1e-6] for each in waves]

        return calibrated(waves_of, channels / unit[:, None], START, np.full(len(rows), 1 / SNR))[0]


def main() -> dict[str, Any]:
    """Rows have ``unexplained_db`` and ``power_db`` by receiver (`figures`), and constants that were calibrated."""
    data = data_home() / NAME
    if not (data / OUTPUT).is_file():
        raise InputError(f"{data / OUTPUT}: not on this machine; put the files of {SOURCE} there")
    wide = measured_channels(data / OUTPUT, WIDE_HZ)
    record, split = toy_record(wide, WIDE_HZ)
    rows = list[dict[str, Any]]()

    def add(what: str, predicted: tuple[Complex, FloatArray], **more: Any) -> None:
        result = figures(wide, *predicted)
        third = f"{result['unexplained_db'][2]:.1f} dB unexplained, power {result['power_db'][2]:+.1f} dB"
        rows.append({**line(what, f"third receiver: {third}", "-"), **result, **more})
        say("fdtd", f"{what}: {third}")

    with TemporaryDirectory() as folder:
        place, kinds = Path(folder), ("ground_truth", "dt_model")
        true, model = (data / f"toy_example_maxwell_{kind}" for kind in kinds)
        truth = scene_of(true, place / "truth", CONCRETE)
        add("true scene", traced(truth, record))
        add("true scene, with diffraction", traced(truth, record, DIFFRACTED))
        add("twin, true materials", traced(scene_of(model, place / "twin", CONCRETE), record))
        brick = scene_of(model, place / "brick", BRICK)
        add("twin, brick", traced(brick, record))
        for band, hz in BANDS.items():
            fitted = toy_record(measured_channels(data / OUTPUT, hz), hz)
            for what, scene, more in _corrections(brick, model, place, *fitted):
                add(f"{what}, {band}", traced(scene, record), band=band, **more)
        for what, (named, settings) in TRAINED.items():
            run = wrf_mi.train(record, named, brick, split=split, settings=settings)
            channels = np.asarray(run.predict(record.tx_pos_m[::READINGS]).mean, complex).reshape(wide.shape)
            power_db = 10 * np.log10(np.square(np.abs(channels)).mean(axis=1))
            add(f"{what}, 2 GHz", (channels, power_db), band="2 GHz", seconds=run.metrics["train_seconds"])
    return {"rows": rows}


def _corrections(
    brick: Path, model: Path, place: Path, record: Record, split: Split
) -> Iterator[tuple[str, Path, dict[str, Any]]]:
    """The twin with walls of brick after each calibration by the first two receivers, and materials of both walls."""
    groups = {
        "`--calibrate materials`": ("materials",),
        "`--calibrate materials,planes,phases`": ("materials", "planes", "phases"),
    }
    for what, chosen in groups.items():
        correction = correct_scene(brick, record, split, CorrectionOptions(chosen))
        write_page(correction, place / "corrected", replace=True)
        yield what, place / "corrected", {"kept": correction.kept}
    twin = Twin(brick, record, split)
    for what, fit in (("von Mises phases (published)", twin.published), ("likelihood of `phases`", twin.gaussian)):
        logarithms = fit()
        permittivity, conductivity = 1 + float(np.exp(logarithms[0])), float(np.exp(logarithms[1]))
        constants = {**BRICK, "relative_permittivity": permittivity, "conductivity": conductivity}
        yield f"one material, {what}", scene_of(model, place / "phases", constants), constants


table = lined("| scene | unexplained (dB) | power (dB) |", "| {what} | {unexplained_db[2]:.1f} | {power_db[2]:+.1f} |")
"""What is not explained, and errors of power, at the receiver that no calibration knows."""
