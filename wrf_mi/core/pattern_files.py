"""Files of measured antenna patterns: CSV of a sphere or of two cuts, and MSI Planet."""

from __future__ import annotations

import math
import re
from itertools import islice
from pathlib import Path

import numpy as np

from .angles import FloatArray
from .errors import DataFault, InputError
from .files import one_line, text_lines
from .measured_pattern import MeasuredPattern

PLANET = (".msi", ".pln")
PATTERN_FILES = (".csv", *PLANET)  # suffixes of files of patterns
COLUMNS = ("theta", "phi", "gain_db")
PHASE = "phase"
DIPOLE_DBI = 2.15  # gain of a half-wave dipole, to which dBd refer
SAME_DEG = 1e-3  # angles in files are rounded
NUMBER = r"([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)"
FREQUENCY = re.compile(rf"{NUMBER}(?:\s*-\s*{NUMBER})?\s*(MHz|GHz)?", re.IGNORECASE)
GAIN = re.compile(rf"{NUMBER}\s*(dBi|dBd)?", re.IGNORECASE)


def read_pattern(path: Path) -> MeasuredPattern:
    """Read a measured pattern from a file with one of the suffixes `PATTERN_FILES`.

    CSV: columns ``theta,phi,gain_db`` and optionally ``phase``: zenith angle from the antenna's z axis and azimuth from
    its x axis (boresight) towards y, degrees; gain in dBi; phase in degrees. The rows are a sphere, or two cuts, which
    `combined_cuts` combines: theta = 90 for all phi, and phi = 0 for all theta; phi = 180 is not used then.

    MSI Planet: ``GAIN`` in dBd unless dBi is stated; attenuations in dB below it, ``HORIZONTAL`` clockwise from above
    with the boresight at 0, ``VERTICAL`` from the boresight at 0 downwards, straight down at 90; of its back half
    nothing is used.

    Raises:
        InputError: missing or damaged file, directions that are neither a sphere nor two cuts in equal steps, or gains
            of more power than is accepted.
    """
    read = _read_planet if path.suffix.lower() in PLANET else _read_csv
    try:
        return read(path, text_lines(path))
    except DataFault:
        raise
    except InputError as error:  # of the gains as a whole
        raise DataFault(path, str(error)) from None


def combined_cuts(horizontal_db: FloatArray, vertical_db: FloatArray) -> FloatArray:
    """Gains on a sphere [n + 1, m] from two cuts, whose attenuations add up.

    That is the method of 3GPP TR 38.901, table 7.3-1, and of radio planning tools. The attenuation of the horizontal
    cut is that against its value at phi = 0, where both cuts meet, so that a tilted beam is not attenuated twice:

        A(theta, phi) = A_V(theta) + A_H(phi) - A_H(0), at least 0, below the largest gain.

    Args:
        horizontal_db: gains [m] at theta = 90 degrees, of azimuths from 0 in equal steps.
        vertical_db: gains [n + 1] at phi = 0 and zenith angles of 0 to 180 degrees.
    """
    peak = max(horizontal_db.max(), vertical_db.max())
    loss = np.add.outer(peak - vertical_db, horizontal_db[0] - horizontal_db)
    loss[[0, -1]] = peak - vertical_db[[0, -1], None]  # at the poles there is no azimuth
    return np.asarray(peak - np.maximum(loss, 0))


def _read_csv(path: Path, lines: list[str]) -> MeasuredPattern:
    header, *rows = [line.split(",") for line in lines or [""]]
    names = [name.strip().lower() for name in header]
    if names not in ([*COLUMNS], [*COLUMNS, PHASE]):
        text = f"header is {one_line(','.join(header))[:40]!r}; give {','.join(COLUMNS)} and, if measured, {PHASE}"
        raise DataFault(path, text, line=1)
    values: dict[tuple[float, float], list[float]] = {}
    for row, fields in enumerate(rows, start=1):
        try:
            theta, phi, *of_direction = map(float, fields)
        except ValueError:
            theta, of_direction = math.nan, []
        if len(of_direction) != len(names) - 2 or not np.isfinite([theta, phi, *of_direction]).all():
            raise DataFault(path, f"not {len(names)} finite numbers; correct or remove the row", row=row)
        if not 0 <= theta <= 180:
            text = f"theta is {theta:g}; give zenith angles of 0 to 180 degrees, the half behind z at phi + 180"
            raise DataFault(path, text, row=row)
        direction = round(theta / SAME_DEG) * SAME_DEG, round(phi % 360 / SAME_DEG) * SAME_DEG % 360
        if values.setdefault(direction, of_direction) != of_direction:
            raise DataFault(path, "another gain than an earlier row of this direction; remove one of them", row=row)
    return _pattern_of(path, values, len(names) > len(COLUMNS))


def _pattern_of(path: Path, values: dict[tuple[float, float], list[float]], with_phase: bool) -> MeasuredPattern:
    """Pattern of gains and perhaps phases by direction (zenith angle and azimuth, degrees)."""
    thetas, phis = (np.unique(angles) for angles in zip(*values, strict=True)) if values else (np.zeros(0),) * 2
    n, m = len(thetas) - 1, len(phis)
    steps = f"equal steps, theta from 0 to 180 and phi once around with 180 (found {n + 1} theta and {m} phi)"
    if n < 2 or m < 4 or m % 2 or not _equal(thetas, np.linspace(0, 180, n + 1)):
        raise DataFault(path, f"directions are no sphere and no two cuts; give {steps}")
    if not _equal(phis, np.arange(m) * 360 / m):
        raise DataFault(path, f"azimuths are not in equal steps; give {steps}")
    grid = np.full((n + 1, m, 2), np.nan)
    for (theta, phi), of_direction in values.items():
        grid[round(theta * n / 180), round(phi * m / 360), : len(of_direction)] = of_direction
    # A pole may be measured at one azimuth alone.
    for pole in (0, -1):
        at_pole = grid[pole, ~np.isnan(grid[pole, :, 0])]
        if len(at_pole):
            grid[pole, np.isnan(grid[pole, :, 0])] = at_pole[0]
    gain_db, missing = grid[..., 0], np.isnan(grid[..., 0])
    if missing.any():
        cuts = np.zeros_like(missing)
        cuts[:, 0], cuts[[0, -1]], cuts[n // 2] = True, True, n % 2 == 0
        unused = np.zeros_like(missing)
        unused[:, m // 2] = True
        if with_phase or n % 2 or (missing & cuts).any() or (~missing & ~cuts & ~unused).any():
            row, column = np.argwhere(missing & cuts if (missing & cuts).any() else missing)[0]
            text = f"no gain at theta {thetas[row]:g}, phi {phis[column]:g}; give a sphere, or without phase two cuts:"
            raise DataFault(path, f"{text} theta = 90 for all phi, and phi = 0 for all theta")
        gain_db = combined_cuts(gain_db[n // 2], gain_db[:, 0])
    return MeasuredPattern.of_gains(gain_db, np.radians(grid[..., 1]) if with_phase else None)


def _equal(angles: FloatArray, expected: FloatArray) -> bool:
    return bool(np.allclose(angles, expected, rtol=0, atol=2 * SAME_DEG))


def _read_planet(path: Path, lines: list[str]) -> MeasuredPattern:
    keys: dict[str, str] = {}
    cuts: dict[str, FloatArray] = {}
    numbered_lines = iter(enumerate(lines, start=1))
    for line, text in numbered_lines:
        key, value = [*text.split(maxsplit=1), "", ""][:2]
        if key.upper() in ("HORIZONTAL", "VERTICAL"):
            if not value.strip().isdecimal() or len(value) > 9:
                raise DataFault(path, f"{one_line(text)[:40]!r} has no number of angles; give 360", line=line)
            count = int(value)
            cuts[key.upper()] = _attenuations(path, line, [text for _, text in islice(numbered_lines, count)], count)
        else:
            keys[key.upper()] = value.strip()
    gain = GAIN.fullmatch(keys.get("GAIN", ""))
    if gain is None or len(cuts) < 2 or len({len(cut) for cut in cuts.values()}) > 1:
        wanted = "GAIN in dBd or dBi, and HORIZONTAL and VERTICAL with the same number of angles"
        raise DataFault(path, f"no antenna pattern of MSI Planet; give {wanted}")
    peak_dbi = float(gain[1]) + DIPOLE_DBI * ((gain[2] or "dBd").lower() == "dbd")
    frequency = FREQUENCY.fullmatch(keys.get("FREQUENCY", ""))
    frequency_hz = 0.0
    if frequency is not None:  # a band stands for its middle
        middle = (float(frequency[1]) + float(frequency[2] or frequency[1])) / 2
        frequency_hz = middle * (1e9 if (frequency[3] or "").lower() == "ghz" else 1e6)
    horizontal, vertical = (peak_dbi - cuts[name] for name in ("HORIZONTAL", "VERTICAL"))
    # Azimuths run clockwise in the file, and the vertical cut from the boresight down: zenith angle - 90 degrees.
    m = len(horizontal)
    gain_db = combined_cuts(horizontal[-np.arange(m)], vertical[np.arange(m // 2 + 1) - m // 4])
    return MeasuredPattern.of_gains(gain_db, frequency_hz=frequency_hz if 0 < frequency_hz < math.inf else None)


def _attenuations(path: Path, line: int, texts: list[str], count: int) -> FloatArray:
    """Attenuations [count] of a cut whose caption is on a line."""
    if count % 4 or not 8 <= count <= 3600:
        raise DataFault(path, f"{count} angles; give 360, or another multiple of 4 from 8 to 3600", line=line)
    values = np.full(count, np.nan)
    for place, text in enumerate(texts, start=line + 1):
        try:
            angle, attenuation = map(float, text.replace(",", " ").split())
        except ValueError:
            angle, attenuation = math.nan, math.nan
        if not (math.isfinite(angle) and 0 <= attenuation < math.inf):
            text = f"{one_line(text)[:40]!r} is no angle and attenuation; give degrees and dB from 0 up"
            raise DataFault(path, text, line=place)
        values[round(angle * count / 360) % count] = attenuation
    if np.isnan(values).any():
        angle = 360 * int(np.argmax(np.isnan(values))) / count
        raise DataFault(path, f"no attenuation at {angle:g} degrees in these {count}; give one for each", line=line)
    return values
