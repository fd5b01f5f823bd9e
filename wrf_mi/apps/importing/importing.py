"""Import of tables of signal strengths into a folder that all commands read."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from ...core import DataFault, InputError, Receiver, Record
from ...core.angles import FloatArray
from ...core.files import listed, one_line
from ...core.types import IntArray
from ...datasets.ble_folder import CARRIER_HZ, write_ble_folder
from ...datasets.unknown import SENT, name_words
from ...tasks import RSSI
from .carriers import carriers_of_receivers, column_hz
from .column_names import PIXELS
from .files import Table, joined, read_table
from .fixes import with_fixes, without_stale
from .forms import described, find_columns, parsed_columns, without_slots
from .options import ImportOptions, option_name
from .picture import plan_picture
from .places import (
    POSITION_DIGITS,
    LocalFrame,
    find_frame,
    finite_columns,
    floor_numbers,
    headings_rad,
    place_numbers,
    plane_columns,
    unit_scale,
    with_cells,
    with_positions,
)
from .pooled import refuse_no_dbm, refuse_per_cent, refuse_several_kinds, texts_of_readings
from .readings import (
    Means,
    Readings,
    file_offsets,
    further_columns,
    mean_strengths,
    read_readings,
    without_not_heard,
)
from .receivers_table import read_receivers
from .registration import registered_frame
from .trajectories import upright

FACTS, PICTURE = "import.yml", "plan.png"  # files beside the tables: what the import assumed, and a plan of the rows
MOST_STEPS = 500  # largest extent of whole numbers that may be indices of a grid
MOST_CELLS = 50_000_000  # largest number of receivers times places: 2 GB while means are computed
TRAIN_WORDS, TEST_WORDS = ("train", "training", "validation", "valid", "val"), ("test", "testing")
SENT_IN_NAME = re.compile(r"(?<![\d.])(-?\d+(?:\.\d+)?)[ _]?dbm", re.IGNORECASE)
STRENGTH_DIGITS = 4  # decimals of means and their noise in dB


@dataclass(frozen=True)
class ImportReport:
    """What `import_measurements` wrote.

    Attributes:
        folder: the data set.
        record: its content.
        columns: lines of a table: column, meaning, unit and number of values.
        notes: what was found and assumed.
    """

    folder: Path
    record: Record
    columns: tuple[str, ...]
    notes: tuple[str, ...]


def import_measurements(
    files: str | Path | Sequence[str | Path], out: str | Path, replace: bool = False, **options: Any
) -> ImportReport:
    r"""Make a data set of signal strengths from tables as people have them.

    A table has a column for each receiver, or a row for each reading with an id and a strength. Readings of a receiver
    at one place are averaged. The folder also holds ``import.yml`` with all that was assumed, and ``plan.png``.

    Args:
        files: tables in CSV, Parquet or Excel, JSON of surveys, and logs (docs/howto/surveys.md); their rows train,
            unless there is a column ``split``.
        out: folder to write.
        replace: whether an existing folder is replaced.
        options: attributes of `ImportOptions`.

    Raises:
        InputError: an unknown option, a table or a field that cannot be understood, or a folder that exists.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> rows = ["x,y,bssid,rssi", "0,0,hall,-50", "0,0,hall,-52", "2,0,hall,-60", "2,0,attic,-71"]
    >>> _ = (folder / "scans.csv").write_text("\n".join(rows))
    >>> report = import_measurements(folder / "scans.csv", folder / "office")
    >>> [receiver.name for receiver in report.record.receivers]
    ['hall', 'attic']
    >>> report.record.observation
    array([[-51., -60.],
           [ nan, -71.]], dtype=float32)
    """
    if unknown := set(options) - {attribute.name for attribute in dataclasses.fields(ImportOptions)}:
        raise InputError(f"import_measurements: no option {min(unknown)}; see ImportOptions")
    if Path(out).exists() and not replace:
        raise InputError(f"{out}: exists; remove it, choose another folder, or give --replace")
    chosen_options = ImportOptions(**options)
    files = [files] if isinstance(files, str | Path) else list(files)
    return _Import(files, Path(out), chosen_options).run(replace)


class _Import:
    """One import: its table, columns and notes, which each step extends."""

    def __init__(self, files: Sequence[str | Path], out: Path, options: ImportOptions) -> None:
        self.out, self.options, self.notes = out, options, list[str]()
        columns = options.columns
        self.stated = parsed_columns(columns) if isinstance(columns, str) else dict(columns)
        self.table, self.is_test = self._read(files)
        if "cell" in self.stated:
            self.table = with_cells(self.table, self.stated["cell"])
        self.notes += self.table.notes
        self.columns = find_columns(self.table, self.stated, options.receivers)
        self.units, self.carrier_of = dict[str, str](), dict[str, float]()
        self.facts: dict[str, Any] = {"files": [path.name for path, _ in self.table.files]}

    def run(self, replace: bool) -> ImportReport:
        """Read, average and write."""
        self._check_idle()
        refuse_per_cent(self.table, self.columns)

        # Positions of the rows, and single readings without numbers for "not heard".
        frame, xyz_m = self._positions()
        readings = read_readings(self.table, self.columns)
        refuse_no_dbm(self.table, readings)
        readings, notes, not_heard = without_not_heard(readings, self.options.not_heard)
        self.notes += notes
        if not len(readings.dbm):
            raise DataFault(self.table.files[0][0], "no reading was heard; correct --columns or --not-heard")
        refuse_several_kinds(self.table, self.columns, readings)

        # Rows of one position, heading, carrier, run and part of the split are averaged.
        conditions = self._conditions(readings, frame)
        keys = {"z": xyz_m[:, 2], **conditions, "part": self.is_test}
        place = place_numbers(keys, xyz_m[:, :2], self.options.place_m)
        count = np.bincount(place)
        self.notes += file_offsets(readings, place, self._file, [path.name for path, _ in self.table.files])
        first = np.unique(place, return_index=True)[1]
        ids, means = self._means(readings, place, len(count))
        position_m = np.column_stack([np.bincount(place, axis) / count for axis in xyz_m.T]).round(POSITION_DIGITS)

        # The record, with what its rows state.
        receivers, notes = self._receivers(ids, frame)
        self.notes += notes
        record = self._record(means, position_m, receivers)
        record = self._with_conditions(record, {name: values[first] for name, values in conditions.items()})
        record = self._with_split(record, self.is_test[first])

        # Files: tables, facts and picture.
        if further := further_columns(self.table, self.columns, place):
            self.notes.append(f"kept as columns that no model uses: {listed(further)}")
        fixed = one_line(self.columns.of.get("id", "the columns of strengths"))
        text = f"the fixed ends, named by {fixed}, are the receivers, and the moving end is the transmitter"
        self.notes.append(f"{text}: by reciprocity it does not matter who sends")
        lines = described(self.table, self.columns, self.units)
        self.facts |= {"columns": lines, "frame": frame.facts(), "not_heard_dbm": not_heard, "notes": self.notes}
        extra: dict[str, str | bytes] = {
            FACTS: yaml.safe_dump(self.facts, sort_keys=False, allow_unicode=True, width=120),
            PICTURE: plan_picture(record),
        }
        write_ble_folder(self.out, record, replace, extra, further)
        return ImportReport(self.out, record, tuple(lines), tuple(self.notes))

    def _read(self, files: Sequence[str | Path]) -> tuple[Table, NDArray[np.bool_]]:
        """All rows with their positions, and which of them test."""
        options = self.options

        # Tables, each with positions of another file, if any.
        paths = [*files, *options.test]
        as_is = {"id", "rssi"} <= self.stated.keys()
        tables = [without_stale(read_table(path, options.sheet, as_is), self.stated) for path in paths]
        positions = [upright(read_table(path, options.sheet), options.up) for path in options.positions]
        if len(positions) not in (0, 1, len(paths)):
            text = f"{len(positions)} files of positions for {len(paths)} tables"
            raise InputError(f"--positions: {text}; give one for each table, those of --test last, or one for all")
        if positions:
            positions *= len(paths) // len(positions)
            pairs = [with_positions(*pair, self.stated) for pair in zip(tables, positions, strict=True)]
            tables = [table for table, _ in pairs]
            self.notes += positions[0].notes[1:]
            self.notes.append(f"positions of {options.positions[0]} are matched {pairs[0][1]}")

        # One table of all rows that are chosen, and the number of each row's file.
        tables = [with_fixes(table, self.stated) for table in tables]
        tables = tables if as_is else [without_slots(table) for table in tables]
        self._file = np.repeat(np.arange(len(paths)), list(map(len, tables)))
        table = joined(tables)
        for name, text in options.where.items():
            chosen_rows = table.where(name, text)
            left_out = len(table) - np.count_nonzero(chosen_rows)
            self.notes.append(f"{left_out} rows are left out: their {one_line(name)} is not {one_line(text)}")
            frame = table.frame[chosen_rows].dropna(axis=1, how="all")  # columns of other kinds of rows
            table = dataclasses.replace(table, frame=frame)
            self._file = self._file[chosen_rows]
        return table, self._file >= len(files)

    def _check_idle(self) -> None:
        """Refuse options of quantities that the tables state, or do not have."""
        of, without_z, pairs = self.columns.of, "z" not in self.columns.of, self.options.register_pairs
        is_registered = pairs is not None or self._unit() in PIXELS
        needed = {
            "height_m": (without_z, "the table has a column z"),
            "storey_m": (without_z and "floor" in of, "it belongs to a column floor without z"),
            "heading": ("heading" in of, "the table has no column of headings"),
            "anchor_height_m": (self.options.anchors is not None, "it belongs to --anchors"),
            "register_pairs": ("x" in of, "positions are longitude and latitude"),
            "pitch_m": (not is_registered, "positions are pixels, or registered by pairs"),
            "crs": (not is_registered, "positions are pixels, or registered by pairs"),
            "plan": (self._unit() in PIXELS and pairs is None, "it belongs to --units px"),
            "resolution_m": (self.options.plan is not None, "it belongs to --plan"),
            "origin_m": (self.options.plan is not None, "it belongs to --plan"),
            "up": (bool(self.options.positions), "it belongs to a trajectory of --positions"),
        }
        for name, (counts, reason) in needed.items():
            if not counts and getattr(self.options, name) != getattr(ImportOptions, name):
                raise DataFault(self.table.files[0][0], f"{option_name(name)}: {reason}; omit it")

    def _unit(self) -> str:
        """Unit of positions that is stated by an option, a column's name, or a survey with a picture; or ""."""
        options, of, table = self.options, self.columns.of, self.table
        unit = options.units or self.columns.unit("x" if "x" in of else "lon")
        if not unit and not options.pitch_m and table.image and "x" in of:
            where = f"x and y are points of {one_line(table.image)}; give --units px --plan {shlex.quote(table.image)}"
            text = "--resolution M (metres of a pixel), --units px --register-pairs pairs.csv, or --units m"
            raise DataFault(table.files[0][0], f"{where} {text}")
        return unit

    def _positions(self) -> tuple[LocalFrame, FloatArray]:
        """The local frame and the positions [rows, 3] in it."""
        options, table, of = self.options, self.table, self.columns.of
        first, second, geographic = plane_columns(of, table)
        xy = finite_columns(table, [first, second])
        unit = self._unit()
        if unit in PIXELS or options.register_pairs is not None:
            pairs, is_pixels = options.register_pairs, unit in PIXELS
            frame, note = registered_frame(xy, options.plan, options.resolution_m, options.origin_m, pairs, is_pixels)
            self.units |= {"x": unit or "registered", "y": unit or "registered"}
            self.notes.append(note)
            return frame, np.column_stack([frame.local_m(xy), self._heights_m()])
        scale_m = options.pitch_m or unit_scale(unit, "--units")
        frame, notes = find_frame(xy, geographic, unit, scale_m, options.crs)
        self.notes += notes
        if not options.pitch_m and (xy == np.round(xy)).all() and np.ptp(xy, axis=0).max() < MOST_STEPS:
            self.notes.append("x and y are whole numbers: if they are indices of a grid, state its pitch by --pitch")
        shown = f"steps of {options.pitch_m:g} m" if options.pitch_m else frame.crs or unit or "m"
        self.units |= dict.fromkeys(("x", "y", "lat", "lon"), shown)
        return frame, np.column_stack([frame.local_m(xy), self._heights_m()])

    def _heights_m(self) -> FloatArray:
        """Heights of the rows, from z, the floor, or an assumption."""
        options, table, of = self.options, self.table, self.columns.of
        if "z" in of:
            unit = "m" if options.units in ("deg", *PIXELS) else options.units
            self.units["z"] = self.columns.unit("z") or unit or "m"
            return finite_columns(table, [of["z"]])[:, 0] * unit_scale(self.units["z"], "--units")
        count, stated_m = int(self._file.max()) + 1, np.atleast_1d(np.asarray(options.height_m, float))
        if len(stated_m) not in (1, count):
            raise InputError(f"--height: {len(stated_m)} heights for {count} tables; give one for each, or one for all")
        height_m = np.broadcast_to(stated_m, count)[self._file]
        if "floor" in of:
            floors = floor_numbers(table, of["floor"])
            names = dict(zip(table.frame[of["floor"]].astype(str), floors * options.storey_m, strict=True))
            shown = listed(
                [f"{one_line(name)} at {z:g} m" for name, z in sorted(names.items(), key=lambda item: item[1])]
            )
            self.notes.append(f"floors by names and storeys of {options.storey_m:g} m (--storey): {shown}")
            return height_m + options.storey_m * floors
        heights_m = np.unique(height_m)
        text = "all rows are" if len(heights_m) == 1 else "rows are"
        self.notes.append(f"no column z: {text} {listed([f'{z:g}' for z in heights_m])} m above the floor (--height)")
        return height_m

    def _sent(self, readings: Readings) -> NDArray[np.str_] | None:
        """Sent power of each row, "" where none is stated, if a receiver has several: by a column or names of files."""
        for name in self.table.frame.columns:
            values = texts_of_readings(self.table, name, readings)
            several = values.groupby(readings.receiver[values.index]).nunique().max() > 1
            if name_words(name) & SENT and self.table.is_numeric(name) and several:
                self.notes.append(f"{one_line(name)} is {listed(values.unique())}: a run for each, with its offset")
                column = self.table.frame[name]
                pairs = zip(column, column.isna(), strict=True)
                return np.array(["" if missing else f"{float(power):g}" for power, missing in pairs])
        powers = [SENT_IN_NAME.search(path.stem) for path, _ in self.table.files]
        texts = np.array([match[1] if match else "" for match in powers])
        if len(distinct := sorted({*texts} - {""}, key=float)) < 2:
            return None
        self.notes.append(f"files at {', '.join(distinct)} dBm sent, by their names: a run for each, with its offset")
        return np.asarray(texts[self._file])

    def _conditions(self, readings: Readings, frame: LocalFrame) -> dict[str, Any]:
        """Heading, carrier and run of each row where stated; rows that differ in them are not averaged."""
        of, table, conditions = self.columns.of, self.table, {}
        if "split" in of:
            self.is_test = self.is_test | _test_rows(table, of["split"])
        for meaning in sorted({"heading", "run"} & set(of)):
            if empty := int(table.frame[of[meaning]].isna().sum()):
                self.notes.append(f"{of[meaning]} is empty in {empty} rows: kept, and not used as {meaning}")
                self.columns.kept.append(of.pop(meaning))
        if "heading" in of:
            headings = finite_columns(table, [of["heading"]])[:, 0]
            headings, unit = headings_rad(headings, of["heading"], self.options.heading)
            conditions["heading"] = headings if "north" in unit else frame.headings_rad(headings)
            self.units["heading"] = unit
        if "run" in of:
            conditions["run"] = table.frame[of["run"]].astype(str).str.strip().to_numpy(str)
        if (sent := self._sent(readings)) is not None:
            runs = conditions.get("run", np.full(len(sent), ""))
            powers = [f"{power} dBm" if power else "of no stated power" for power in sent]
            conditions["run"] = np.array([f"{run} {power}".strip() for run, power in zip(runs, powers, strict=True)])
        if "frequency" in of and not self.options.frequency_hz:
            self.units["frequency"] = "-> Hz"
            carriers_hz = column_hz(table, of["frequency"])
            self.carrier_of, notes = carriers_of_receivers(carriers_hz, readings)
            self.notes += notes
            conditions |= {} if self.carrier_of else {"frequency_hz": carriers_hz}
        return conditions

    def _means(self, readings: Readings, place: IntArray, places: int) -> tuple[list[str], Means]:
        """Ids of the receivers that remain, and the means of their readings at each place."""
        options = self.options
        if places * len(readings.ids) > MOST_CELLS:
            text = f"{places} places of {len(readings.ids)} receivers do not fit into memory ({MOST_CELLS} values do)"
            raise InputError(f"{self.out}: {text}; average by --place, or leave receivers out by --receivers")
        means = mean_strengths(readings, place, places, options.average)
        trains = ~self.is_test[np.unique(place, return_index=True)[1]]
        heard = (means.count[:, trains] > 0).sum(axis=1)
        remaining = np.flatnonzero(heard >= max(1, options.min_heard))
        if len(out := np.setdiff1d(np.arange(len(heard)), remaining)):
            names = listed([readings.ids[number] for number in out])
            text = f"{len(out)} of {len(heard)} receivers were heard in fewer than {max(1, options.min_heard)} training"
            self.notes.append(f"{text} rows and are left out (--min-rows): {names}")
        if not len(remaining):
            text = f"no receiver was heard in {options.min_heard} training rows; lower --min-rows"
            raise InputError(f"{self.out}: {text}")
        ids = [readings.ids[number] for number in remaining]
        return ids, Means(means.dbm[remaining], means.count[remaining], means.std[remaining])

    def _receivers(self, ids: Sequence[str], frame: LocalFrame) -> tuple[tuple[Receiver, ...], list[str]]:
        """Receivers with the carriers of their readings, if these state any."""
        options = self.options
        table = None if options.anchors is None else read_table(options.anchors, options.sheet)
        unit = PIXELS[0] if self._unit() in PIXELS else options.units
        receivers, notes = read_receivers(table, ids, frame, unit, options.anchor_height_m)
        pairs = zip(ids, receivers, strict=True)
        carriers = [self.carrier_of.get(name, receiver.frequency_hz) for name, receiver in pairs]
        if None in carriers or options.frequency_hz:  # one carrier for all
            carriers = [None] * len(carriers)
        with_carriers = zip(receivers, carriers, strict=True)
        return tuple(dataclasses.replace(receiver, frequency_hz=hz) for receiver, hz in with_carriers), notes

    def _record(self, means: Means, position_m: FloatArray, receivers: tuple[Receiver, ...]) -> Record:
        averaged = bool((means.count > 1).any())
        if averaged:
            most, what = int(means.count.max()), {"db": "dB", "mw": "mW"}[self.options.average]
            text = f"{means.count.sum()} readings at {len(position_m)} places are averaged in {what}, up to {most} each"
            self.notes.append(f"{text}; count_ and std_ are their number and the noise of the mean")
        carrier_hz = self.options.frequency_hz or CARRIER_HZ
        states_carrier = "frequency" in self.columns.of or receivers[0].frequency_hz
        if not self.options.frequency_hz and not states_carrier:
            self.notes.append(f"no carrier is stated: {carrier_hz:.4g} Hz (--frequency)")
        return Record(
            name=self.out.name,
            task=RSSI,
            tx_pos_m=position_m,
            receivers=receivers,
            observation=means.dbm.round(STRENGTH_DIGITS).astype(np.float32),
            frequencies_hz=np.array([carrier_hz]),
            n_readings=means.count if averaged else None,
            std=means.std.round(STRENGTH_DIGITS) if averaged else None,
        )

    def _with_conditions(self, record: Record, conditions: Mapping[str, NDArray[Any]]) -> Record:
        record = dataclasses.replace(record, tx_heading_rad=conditions.get("heading"), runs=conditions.get("run"))
        of_receivers = record.receiver_carriers_hz
        return record.at_carriers(conditions.get("frequency_hz")).at_receiver_carriers(of_receivers)

    def _with_split(self, record: Record, is_test: NDArray[np.bool_]) -> Record:
        if not is_test.any() or is_test.all():
            self.notes.append("no test rows are stated: train scores folds in space, then fits all rows (--split none)")
            return record
        official = np.flatnonzero(~is_test), np.flatnonzero(is_test)
        self.notes.append(f"split: {len(official[0])} training and {len(official[1])} test rows, as stated")
        return dataclasses.replace(record, official=official)


def _test_rows(table: Table, column: str) -> NDArray[np.bool_]:
    words = table.frame[column].astype(str).str.strip().str.lower().to_numpy(str)
    valid = np.isin(words, (*TRAIN_WORDS, *TEST_WORDS))
    if len(wrong := np.flatnonzero(~valid)):
        text = f"{one_line(column)} is {one_line(words[wrong[0]])!r}; give train or test, or --columns split=-"
        raise table.fault(text, int(wrong[0]))
    return np.isin(words, TEST_WORDS)
