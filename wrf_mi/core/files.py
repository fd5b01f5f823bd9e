"""Atomic writing of files and folders, and reading with errors that name file and remedy."""

from __future__ import annotations

import csv
import errno
import io
import os
import re
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from .errors import DataFault, InputError

MOST_MESSAGE = 400  # characters that are shown of another library's message: some repeat the content of a file


def one_line(error: object) -> str:
    """The message of another library's error on one line."""
    text = " ".join(str(error).split())
    return text if len(text) <= MOST_MESSAGE else f"{text[:MOST_MESSAGE]} ..."


MOST_LISTED = 6  # names, or lines of the same kind, that a message has at most


def listed(names: Iterable[str], most: int = MOST_LISTED, mark: str = ", ") -> str:
    """The first names, and the number of the others."""
    names = list(names)
    return mark.join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free some space or choose another disk"),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "change its permissions or choose another place"),
    **dict.fromkeys((errno.EISDIR, errno.ENOTDIR, errno.EEXIST), "choose another place: a file or folder is there"),
    errno.ENOENT: "check the name",
}
"""Remedies of frequent errors; the texts of others, such as "File name too long", say what to do."""


def os_failure(error: OSError, path: Path | None = None, what: str = "") -> str:
    """An error of the operating system and its remedy, on one line, beside a ``path`` or the one that it names.

    ``what`` is a verb phrase, such as "cannot be written".
    """
    file = path or (error.filename2 if error.filename2 is not None else error.filename)
    text = one_line(error.strerror or error)
    text = f"{what} ({text})" if what else text
    if isinstance(file, str | bytes | os.PathLike):
        text = f"{os.fsdecode(file)}: {text}"
    remedy = _REMEDIES.get(error.errno or 0)
    return f"{text}; {remedy}" if remedy else text


MOST_NAME = 1024  # characters of a name that another file states; systems take 4096 of a whole path


def inside(folder: Path, name: object, source: str | Path) -> Path:
    """The path in a folder of the file that another file, the ``source``, names.

    `InputError`: no name, or one that leaves the folder.
    """
    if not isinstance(name, str) or not name or "\0" in name or len(name) > MOST_NAME:
        raise DataFault(source, f"{one_line(repr(name))[:60]} is no name of a file; correct it")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DataFault(source, f"{name[:60]!r} is outside its folder; copy the file there and name it so")
    return path


def text_lines(path: Path) -> list[str]:
    """The lines of a UTF-8 text file without line ends and trailing blank lines; `InputError`: missing, or no text."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise DataFault(path, "missing; give a file that exists, or complete its folder") from None
    except OSError as error:
        raise DataFault(path, os_failure(error, path, "cannot be read").removeprefix(f"{path}: ")) from None
    except UnicodeDecodeError as error:
        raise DataFault(path, f"cannot be read ({one_line(error)}); give a UTF-8 text file") from None
    return text.rstrip().splitlines()


@contextmanager
def readable(path: Path, missing: str | InputError, remedy: str) -> Iterator[None]:
    """Turn any error of a block that reads a file into `InputError`: ``missing``, or for a damaged file ``remedy``."""
    try:
        yield
    except FileNotFoundError:
        raise (InputError(missing) if isinstance(missing, str) else missing) from None
    except InputError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise DataFault(path, f"not readable ({one_line(error)}); {remedy}") from None


LEFTOVER = re.compile(r"\.(.+)\.(\d{1,9})\.(part|old)")
"""Name of a temporary file or folder: the name that it is to take or had, and the number of its process."""


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove temporary files and folders that killed processes left in a folder, at any depth.

    A folder that was to be replaced, and had lost its name, takes it again. With a ``name`` only leftovers beside the
    file or folder of this name are removed.
    """
    for path in folder.glob(".*.*") if name is not None else folder.rglob(".*.*"):
        leftover = LEFTOVER.fullmatch(path.name)
        # Files of this process count: it makes each temporary file once.
        if leftover is None or ((process := int(leftover[2])) != os.getpid() and psutil.pid_exists(process)):
            continue
        last = leftover[1]
        while inner := LEFTOVER.fullmatch(last):  # a temporary folder that is written atomically itself
            last = inner[1]
        if name in (None, last):
            with suppress(OSError):
                _remove_leftover(path, path.with_name(last) if (last, "old") == leftover.group(1, 3) else None)


def _remove_leftover(path: Path, former: Path | None) -> None:
    """Give a replaced folder its former name, if it is free; remove all else."""
    if former is not None and not former.exists():
        os.replace(path, former)
    elif path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink()


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` that replaces it if the block succeeds and is removed otherwise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path, replace: bool = False) -> Iterator[Path]:
    """A temporary folder beside ``path`` that takes its name if the block succeeds and is removed otherwise.

    `InputError`: ``path`` exists and may not be replaced, or cannot be written.
    """
    remove_leftovers(path.parent, path.name)
    if path.exists() and not replace:
        raise InputError(f"{path}: exists; remove it, choose another folder, or give --replace")
    part, old = (path.with_name(f".{path.name}.{os.getpid()}.{end}") for end in ("part", "old"))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
    except OSError as error:
        raise InputError(os_failure(error, path, "cannot be written")) from None
    try:
        yield part
        if replace and path.exists():
            os.replace(path, old)
        os.replace(part, path)
    finally:
        for folder in (part, old):
            shutil.rmtree(folder, ignore_errors=True)


def write_atomically(path: Path, content: bytes | str) -> Path:
    """Write a small file atomically."""
    with atomic_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_csv(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> Path:
    """Write a table as CSV with a header, atomically: numbers to their last digit, None and NaN as empty fields."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    # Only NaN differs from itself.
    writer.writerows(["" if value is None or value != value else value for value in row] for row in rows)
    return write_atomically(path, text.getvalue())


def append_line(path: Path, line: str) -> None:
    """Append a line to a text file; where the disk is full, the file stays as it was."""
    with path.open("ab", buffering=0) as stream:
        before, content = stream.tell(), f"{line}\n".encode()
        try:
            while content:
                content = content[stream.write(content) :]
        except OSError:
            stream.truncate(before)
            raise


def write_figure(path: Path, figure: Any) -> Path:
    """Write a Matplotlib figure as PNG atomically."""
    with atomic_file(path) as part:
        figure.savefig(part, format="png", dpi=110, metadata={"Software": None})
    return path
