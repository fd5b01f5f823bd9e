"""Captures of many-antenna base stations in HDF5: Argos traces and those of RENEW's sounder.

A base station's antennas receive the pilots of one user after another, frame by frame. ``docs/data.md`` has the two
layouts and how channels are estimated. Sources, and what they add to it:

- ArgosV2: Shepard, Ding, Guerra, Zhong, "Understanding real many-antenna MU-MIMO channels", Asilomar 2016; reader:
  ``samps2csi`` with ``legacy=True`` in RENEWLab's ``PYTHON/IrisUtils/hdf5_lib.py``. The attribute ``measured_noise`` is
  1 where a further slot after the users' holds noise. In each slot the pilot begins at sample 15 with a guard of 32.
- RENEW's sounder: https://github.com/renew-wireless/RENEWLab, ``hdf5_lib.py`` and ``channel_analysis.py``. After the
  prefix there are as many pilot symbols as fit, each after its cyclic prefix.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import DataFault, InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.array_files import MOST_DEFLATED
from ..core.files import one_line
from ..core.memory import require_memory
from ..tasks import CSI
from .faults import attempt
from .folder_files import shown, single_file

SUFFIXES = (".hdf5", ".h5")
PILOTS = "Pilot_Samples"
FFT = 64  # samples of an OFDM symbol at 20 MHz (IEEE 802.11)
HALF = 26  # subcarriers of the long training symbol on each side of zero
SUBCARRIERS = np.concatenate([np.arange(-HALF, 0), np.arange(1, HALF + 1)])
# IEEE Std 802.11-2020, equation (17-8): the long training symbol at subcarriers -26..-1 and 1..26.
_SIGNS = "++--++-+-++++++--++-+-++++" + "+--++-+-+-----++--+-+-++++"
TRAINING = np.array([1.0 if sign == "+" else -1.0 for sign in _SIGNS])
ARGOS_START, ARGOS_SYMBOLS = 47, 2
"""First sample of the first pilot symbol in a user's slot, and number of symbols (RENEWLab, ``samps2csi``)."""
FULL_SCALE = 2.0**15  # of samples of 16 bits with a sign
RECORD_BYTES = 2 * HALF * 8  # bytes of a record for each frame, user and antenna
CHUNK_SIZE = 1 << 26  # bytes of samples in a chunk


@dataclass(frozen=True)
class _Layout:
    """Numbers of users and antennas, samples of a user's slot, and first sample of each pilot symbol in it."""

    users: int
    antennas: int
    slot: int
    starts: tuple[int, ...]


def read_argos(
    path: str | Path, name: str | None = None, frames: slice | None = None, cell: int | None = None
) -> Record:
    """Read and check a capture of a many-antenna base station (see ``docs/data.md``).

    Args:
        path: path of the ``.hdf5`` file, or of a folder with such a file.
        name: name of the record; by default that of the file without its ending.
        frames: frames that are read, such as ``slice(0, 4000, 10)``; by default all. A record takes 416 bytes for each
            frame, user and antenna.
        cell: number of the base station, from 0, if the capture holds several.

    Returns:
        A record with ``task="csi"`` and one receiver, whose position is not known: ``observation``
        [1, n, antennas, 26] of the downlink, ``uplink`` [n, antennas, 26], n = frames x users, positions NaN. Samples
        in which all antennas are silent, such as frames that were not captured, are NaN.

    Raises:
        InputError: h5py is not installed, or anything is missing, unreadable or inconsistent, with the file.
    """
    file = single_file(Path(path), SUFFIXES, "one capture in HDF5")
    try:
        import h5py
    except ModuleNotFoundError:
        raise InputError(f"{file}: reading HDF5 needs h5py; install it: pip install '.[argos]'") from None
    try:
        with h5py.File(file, "r") as stored:
            pilots, attributes = _pilots(file, stored)
            layout, samples = _open(file, pilots, attributes, frames, cell)
            channel = np.concatenate([_estimate(part, layout) for part in samples])
    except FileNotFoundError:
        raise DataFault(file, "missing; give a capture in HDF5") from None
    except (OSError, RuntimeError) as error:  # what h5py raises on a damaged file
        raise DataFault(file, f"not readable as HDF5 ({one_line(error)}); fetch it again") from None
    channel = channel.reshape(-1, layout.antennas, 2 * HALF)
    silent = (channel == 0).all(axis=(1, 2))
    if len(channel) - np.count_nonzero(silent) < 2:
        text = f"{len(channel) - np.count_nonzero(silent)} of {len(channel)} samples hold a signal"
        raise DataFault(file, f"{text}; two at least are needed, to train on and to score")
    channel[silent] = np.nan
    uplink_hz, downlink_hz = _frequencies_hz(attributes)
    return Record(
        name=name or file.stem,
        task=CSI,
        tx_pos_m=np.full((len(channel), 3), np.nan),
        receivers=(Receiver("base-station", np.full(3, np.nan), np.array(UPRIGHT)),),
        observation=channel[None, :, :, HALF:],
        frequencies_hz=downlink_hz,
        uplink=channel[:, :, :HALF],
        uplink_hz=uplink_hz,
        source=str(file),
    )


def _frequencies_hz(attributes: dict[str, Any]) -> tuple[FloatArray | None, FloatArray | None]:
    """Frequencies of the uplink's and the downlink's subcarriers, None where they are not stated."""
    carrier_hz, rate_hz = _number(attributes, "FREQ"), _number(attributes, "RATE")
    if carrier_hz is None or rate_hz is None:
        return None, None
    frequencies_hz = carrier_hz + SUBCARRIERS * rate_hz / FFT
    return frequencies_hz[:HALF], frequencies_hz[HALF:]


def _pilots(file: Path, stored: Any) -> tuple[Any, dict[str, Any]]:
    for group in (stored, stored.get("Data")):
        pilots = None if not hasattr(group, "get") else group.get(PILOTS)
        if pilots is not None and hasattr(pilots, "shape"):
            try:
                return pilots, {**stored.attrs, **group.attrs, **pilots.attrs}
            except (KeyError, TypeError, ValueError) as error:  # types and texts that h5py cannot give
                text = f"an attribute cannot be read ({one_line(error)})"
                raise DataFault(file, f"{text}; write it again as a number or as text") from None
    raise DataFault(file, f"neither /{PILOTS} nor /Data/{PILOTS} in it; give a capture with raw pilots")


def _open(
    file: Path, pilots: Any, attributes: dict[str, Any], frames: slice | None, cell: int | None
) -> tuple[_Layout, Iterator[NDArray[Any]]]:
    shape = _check_samples(file, pilots)
    asked = range(shape[0])[frames or slice(None)]
    if not len(asked) or asked.step < 0:
        raise DataFault(file, f"frames {frames} select none of {shape[0]}; give a slice that ascends")
    layout = (_sounder if len(shape) == 5 else _argos)(file, shape, attributes)
    if layout.starts[0] < 0 or layout.starts[-1] + FFT > layout.slot:
        text = f"pilot symbols at {', '.join(map(str, layout.starts))} do not fit in slots of {layout.slot} samples"
        raise DataFault(file, f"{text}; correct its attributes")
    needed = RECORD_BYTES * len(asked) * layout.users * layout.antennas
    require_memory(2 * needed, f"{file}: channels of {len(asked)} frames", "give fewer frames")
    return layout, _chunks(pilots, layout, asked, _cell_number(file, shape, cell))


def _cell_number(file: Path, shape: tuple[int, ...], cell: int | None) -> int:
    """Number of the base station; 0 in a layout without a choice."""
    cells = shape[1] if len(shape) == 5 else 1
    if cells > 1 and cell is None:
        raise DataFault(file, f"{cells} cells; give cell, 0 to {cells - 1}")
    if len(shape) == 5 and not 0 <= (cell or 0) < cells:
        raise DataFault(file, f"no cell {cell}; it has 0 to {cells - 1}")
    return cell or 0


def _chunks(pilots: Any, layout: _Layout, frames: range, cell: int) -> Iterator[NDArray[Any]]:
    """Samples [frames, users, antennas, slot, 2] of at most `CHUNK_SIZE` bytes at a time."""
    step = max(1, CHUNK_SIZE // int(np.prod(pilots.shape[1:]) * pilots.dtype.itemsize))
    for first in range(0, len(frames), step):
        chunk = frames[first : first + step]
        rows = slice(chunk.start, chunk[-1] + 1, chunk.step)
        if pilots.ndim == 4:
            values = pilots[rows][:, :, : layout.users * layout.slot]
            yield values.reshape(len(chunk), layout.antennas, layout.users, layout.slot, 2).swapaxes(1, 2)
        else:
            yield pilots[rows, cell].reshape(len(chunk), layout.users, layout.antennas, layout.slot, 2)


def _check_samples(file: Path, pilots: Any) -> tuple[int, ...]:
    """The shape of the samples, which are whole numbers in the file itself."""
    shape = tuple(int(size) for size in pilots.shape)
    if len(shape) not in (4, 5) or 0 in shape or pilots.dtype.kind != "i":
        need = "[frames, antennas, samples, 2] or [frames, cells, users, antennas, 2 x samples]"
        raise DataFault(file, f"{PILOTS} holds {pilots.dtype} {list(shape)}; whole numbers {need} are read")
    size = file.stat().st_size
    if pilots.nbytes > MOST_DEFLATED * size:
        raise DataFault(file, f"{PILOTS} states {list(shape)} samples, and the file has {size} bytes; fetch it again")
    return shape


def _argos(file: Path, shape: tuple[int, ...], attributes: dict[str, Any]) -> _Layout:
    numbers = [attempt(_whole, file, attributes, key) for key in ("num_mob_ant", "samples_per_user")]
    users, slot = (number.value for number in numbers)
    if shape[3] != 2 or shape[2] < users * slot:
        text = f"{PILOTS} has shape {list(shape)}, but {users} users have {slot} samples each"
        raise DataFault(file, f"{text}; correct num_mob_ant or samples_per_user")
    return _Layout(users, shape[1], slot, tuple(ARGOS_START + k * FFT for k in range(ARGOS_SYMBOLS)))


def _sounder(file: Path, shape: tuple[int, ...], attributes: dict[str, Any]) -> _Layout:
    if shape[4] % 2:
        raise DataFault(file, f"{PILOTS} has {shape[4]} numbers a slot, which are no pairs of I and Q; correct it")
    slot = shape[4] // 2
    attempt(_check_sequence, file, attributes)
    numbers = [attempt(_whole, file, attributes, key) for key in ("CP_LEN", "PREFIX_LEN")]
    guard, prefix = (number.value for number in numbers)
    first, room = guard + prefix, slot - prefix - int(_number(attributes, "POSTFIX_LEN") or 0)
    starts = tuple(first + k * (FFT + guard) for k in range(max(1, room // (FFT + guard))))
    return _Layout(shape[2], shape[3], slot, starts)


def _check_sequence(file: Path, attributes: dict[str, Any]) -> None:
    """Refuse pilots that are not the long training symbol."""
    word = next(iter(np.ravel(attributes.get("PILOT_SEQ_TYPE", "lts"))), "")
    text = word.decode(errors="backslashreplace") if isinstance(word, bytes) else str(word)
    if not text or not isinstance(word, bytes | str):
        what = "empty" if not text else shown(word)
        raise DataFault(file, f"attribute PILOT_SEQ_TYPE is {what}; it must be lts")
    size = _number(attributes, "FFT_SIZE")
    if size not in (None, FFT) or text.lower() != "lts":
        other = f"pilots {text!r} of {size or FFT:g} samples"
        raise DataFault(file, f"{other}; the long training symbol (lts) of {FFT} is read")


def _number(attributes: dict[str, Any], key: str) -> float | None:
    try:
        value = float(np.ravel(attributes[key])[0])
    except (KeyError, IndexError, TypeError, ValueError):
        return None
    return value if np.isfinite(value) else None


def _whole(file: Path, attributes: dict[str, Any], key: str) -> int:
    value = _number(attributes, key)
    if value is None or value < 0 or value != int(value):
        state = f"is {shown(attributes[key])}" if key in attributes else "is missing"
        raise DataFault(file, f"attribute {key} {state}; it must state the layout of {PILOTS}")
    return int(value)


def _estimate(samples: NDArray[Any], layout: _Layout) -> NDArray[np.complex64]:
    """Channel coefficients [frames, users, antennas, 52] of samples [frames, users, antennas, slot, 2]."""
    symbols = np.stack([samples[..., first : first + FFT, :] for first in layout.starts], axis=-3)
    # Estimates of the symbols share one known sequence, so their mean is the estimate from the mean symbol.
    mean = symbols.mean(axis=-3, dtype=np.float32)
    spectrum = np.fft.fft((mean[..., 0] + 1j * mean[..., 1]) / FULL_SCALE, axis=-1)
    # Least squares: the received value of a subcarrier is the channel times the known symbol, +1 or -1, plus noise.
    return (spectrum[..., SUBCARRIERS % FFT] / TRAINING).astype(np.complex64)
