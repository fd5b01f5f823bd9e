"""Data sets of the table: one YAML file each, with rights, place and digests of observations and splits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ...core import InputError, Record
from ...core.digest import content_digest
from ...core.files import write_atomically
from ...core.yaml_files import read_yaml
from ...datasets import make_splits
from ...datasets.registry import KNOWN
from ...synthetic import load_record

FOLDER = "datasets"  # folder of the files, in that of the entries
DIGITS = 16  # hexadecimal digits of a digest


@dataclass(frozen=True)
class Source:
    """A data set of the table."""

    name: str  # name by which entries refer to it
    licence: str  # licence of the data
    origin: str  # author and place
    get: str  # command that fetches, imports or makes it
    building: bool = False  # whether it was measured in a building or outdoors, by a walk or a robot
    redistributable: bool = True  # whether the licence allows to pass it on
    observations: str | None = None  # digest of positions and observations; None: made anew on each machine
    splits: Mapping[str, str] = field(default_factory=dict)  # digest of training and test rows by split


def observations_digest(record: Record) -> str:
    """Digest of task, positions and observations, whatever files hold them."""
    # Files state positions with different numbers of decimals.
    micrometres = np.rint(1e6 * np.nan_to_num(record.tx_pos_m)).astype(np.int64)
    return content_digest(record.task.name, micrometres, record.observation)[:DIGITS]


def split_digest(record: Record, split: str) -> str:
    """Digest of the training and test rows of a split of seed 0."""
    parts = make_splits(record, split, 0)
    return content_digest([(np.sort(part.all_train), np.sort(part.test)) for part in parts])[:DIGITS]


def read_sources(table: Path) -> dict[str, Source]:
    """Data sets of a table by name; licence and origin of those that are known by name are the registry's.

    `InputError` for a file that lacks a field or has an unknown one.
    """
    built_in = {data.name: {"licence": data.licence, "origin": data.origin} for data in KNOWN}
    sources = {}
    for path in sorted((table / FOLDER).glob("*.yml")):
        content = {"name": path.stem} | built_in.get(path.stem, {}) | read_yaml(path)
        if unknown := content.keys() - {field.name for field in fields(Source)}:
            raise InputError(f"{path}: unknown field {sorted(unknown)[0]}; omit it")
        if lacking := [name for name in ("licence", "origin", "get") if name not in content]:
            raise InputError(f"{path}: lacks {lacking[0]}; add it")
        sources[path.stem] = Source(**content)
    return sources


def source_of(table: Path, data: str) -> tuple[Source, Record]:
    """The data set of a table that a name or folder is, with its record.

    `InputError`: none has these observations, or the record has others than its name says.
    """
    record, sources = load_record(data), read_sources(table)
    digest, named = observations_digest(record), sources.get(data)
    if named is not None and named.observations in (None, digest):
        return named, record
    if named is not None:
        text = f"observations {digest}, the table's are {named.observations}"
        raise InputError(f"{data}: {text}; get its version by `{named.get}`")
    if same := [source for source in sources.values() if source.observations == digest]:
        return same[0], record
    raise InputError(f"{data}: not among the table's data sets; add it by `wrf-mi table dataset {data} --name NAME`")


def add_source(table: Path, data: str, name: str, splits: list[str], **stated: Any) -> Path:
    """Write the file of a data set, from its name or folder; `InputError`: the table has one of that name."""
    path = table / FOLDER / f"{name}.yml"
    if path.exists():
        raise InputError(f"{path}: exists; choose another name, or delete it")
    record = load_record(data)
    digests = {split: split_digest(record, split) for split in splits}
    # Rounding of traced data differs between machines.
    is_traced = any(data_set.name == data and data_set.base_url is None for data_set in KNOWN)
    observations = None if is_traced else observations_digest(record)
    source = Source(name=name, observations=observations, splits=digests, **stated)
    content = {key: value for key, value in asdict(source).items() if key != "name"}
    return write_atomically(path, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def faults_of(source: Source, record: Record) -> list[str]:
    """What differs between a data set of a table and its record on this machine, in words."""
    pairs = {"observations": (source.observations, observations_digest(record))}
    pairs |= {f"split {split}": (digest, split_digest(record, split)) for split, digest in source.splits.items()}
    others = {what: pair for what, pair in pairs.items() if pair[0] not in (None, pair[1])}
    return [f"{source.name}: {what} {now}, the table states {then}" for what, (then, now) in others.items()]
