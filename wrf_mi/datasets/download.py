"""Download of known data sets from their public originals at fixed commits, checked by SHA-256.

For converted files (the pickles of NeWRF, `wrf_mi.datasets.newrf`) the resulting arrays are checked in place
of the original, which is not kept.
"""

from __future__ import annotations

import hashlib
import logging
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from urllib.parse import urlsplit

import pooch
import requests
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ..core import InputError
from ..core.array_files import write_arrays
from ..core.files import atomic_folder, one_line
from .newrf import KEYS, arrays_sha256, convert_newrf, read_arrays
from .registry import DATA_VARIABLE, FOLDER, DataSet, RemoteFile, data_home, known, locate, remote_files

THREADS = 8  # number of simultaneous downloads
RETRIES = 2  # number of further attempts after a failure
TIMEOUT_S = 30  # seconds without an answer after which a download fails


def fetch(name: str, *, base_url: str | None = None, progress: bool = True) -> Path:
    """Download a known data set atomically, or check an existing copy; ``base_url`` is that of a mirror.

    Every file, or the arrays of a converted file, must have the published SHA-256. With ``progress`` a bar and the note
    of the data set are shown on standard error.

    Returns:
        The folder of the data set, ``<name>/`` below ``WRF_MI_DATA`` or else in the user's cache.

    Raises:
        InputError: unknown name, no network, a file that is not the published one, or a folder that cannot be written.

    >>> fetch("laboratory")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    wrf_mi.core.errors.InputError: data set laboratory: is not downloaded but ...
    """
    dataset = known(name)
    if dataset.base_url is None:
        raise InputError(f"data set {name}: is not downloaded but {dataset.origin}")
    target = locate(name, data_home()) or data_home() / name
    folder = download(dataset, remote_files(dataset), target, base_url or dataset.base_url, progress)
    if progress and dataset.note:
        print(f"{name}: {dataset.note}", file=sys.stderr)
    return folder


def download(dataset: DataSet, entries: list[RemoteFile], target: Path, base_url: str, progress: bool = False) -> Path:
    """Download ``entries`` from below ``base_url`` into ``target``, with the data set's folds, as `fetch` does."""
    if target.exists():
        _check_copy(target, entries)
        return target
    with atomic_folder(target) as part:
        urls = {entry.path: f"{base_url.rstrip('/')}/{entry.remote}" for entry in entries}
        for entry in entries:  # pooch makes folders too, but not if two threads do at once
            (part / entry.path).parent.mkdir(parents=True, exist_ok=True)
        _fetch_all(part, dataset.name, entries, urls, progress)
        for entry in entries:
            if entry.converted:
                _convert(part / entry.path, entry, f"data set {dataset.name}: {urls[entry.path]}")
        if dataset.folds is not None:
            (part / "blocked_folds.txt").write_bytes((FOLDER / dataset.folds).read_bytes())
        source = f"{dataset.name}: {dataset.origin}\nLicence: {dataset.licence}\n{dataset.note}".strip()
        (part / "SOURCE.txt").write_text(f"{source}\n", encoding="utf-8")
    return target


def _check_copy(folder: Path, entries: list[RemoteFile]) -> None:
    damaged = [entry.path for entry in entries if not _is_intact(folder / entry.path, entry)]
    if damaged:
        text = f"is not the published file ({len(damaged)} of {len(entries)} are not)"
        raise InputError(f"{folder / damaged[0]}: missing or {text}; remove {folder} and fetch it again")


def _convert(path: Path, entry: RemoteFile, source: str) -> None:
    remedy = f"nothing was kept; set {DATA_VARIABLE} to a folder that holds {path.name} in this form"
    try:
        arrays = convert_newrf(path)
    except InputError as error:
        raise InputError(f"{source} cannot be converted ({str(error).removeprefix(f'{path}: ')}); {remedy}") from None
    if arrays_sha256(arrays) != entry.sha256:
        raise InputError(f"{source} does not hold the published arrays, {remedy}")
    write_arrays(path, arrays, compressed=True)


def _fetch_all(folder: Path, name: str, entries: list[RemoteFile], urls: dict[str, str], progress: bool) -> None:
    hashes = {entry.path: None if entry.converted else f"sha256:{entry.sha256}" for entry in entries}
    store = pooch.create(path=folder, base_url="", registry=hashes, urls=urls, retry_if_failed=RETRIES)
    downloader = pooch.HTTPDownloader(timeout=TIMEOUT_S)
    logger = pooch.get_logger()
    level = logger.level
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with (
        Progress(*columns, console=Console(stderr=True), disable=not progress) as bar,
        ThreadPoolExecutor(THREADS) as pool,
    ):
        task = bar.add_task(f"fetching {name}", total=len(store.registry))
        logger.setLevel(logging.WARNING)  # one line per file otherwise
        jobs = {pool.submit(store.fetch, entry.path, downloader=downloader): entry.path for entry in entries}
        try:
            for job in as_completed(jobs):
                if (error := job.exception()) is not None:
                    raise InputError(f"data set {name}: {_failure(error, store.get_url(jobs[job]), name)}") from None
                bar.advance(task)
        finally:
            pool.shutdown(cancel_futures=True)
            logger.setLevel(level)


def _failure(error: BaseException, url: str, name: str) -> str:
    """Why a download failed, and the remedy; any other error is raised."""
    match error:
        case requests.exceptions.HTTPError():
            return f"{one_line(error)}; try again later or give a mirror"
        case requests.exceptions.RequestException():
            remedy = f"check the network, or set {DATA_VARIABLE} to a folder that holds {name}/"
            return f"{urlsplit(url).netloc} cannot be reached; {remedy}"
        case ValueError():  # raised by pooch for a wrong hash
            return f"{url} has not the published SHA-256, nothing was kept; try again"
        case OSError():
            return f"cannot be written ({one_line(error)}); choose another folder"
    raise error


def _is_intact(path: Path, entry: RemoteFile) -> bool:
    if not path.is_file():
        return False
    if not entry.converted:
        return hashlib.sha256(path.read_bytes()).hexdigest() == entry.sha256
    try:
        return arrays_sha256(read_arrays(path, KEYS)) == entry.sha256
    except InputError:
        return False
