"""Errors that a user can correct."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Bad input: one line that names the file, the row and the remedy.

    The command prints the line and ends with exit status 2; nothing is half written.

    >>> import wrf_mi
    >>> wrf_mi.load("nowhere")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    wrf_mi.core.errors.InputError: data set 'nowhere': neither a folder nor known; ...
    """


class DataFault(InputError):
    """Fault of a data file: one line with the file, the place in it, what is wrong, and the remedy.

    Attributes:
        file: path of the file or folder.
        text: what is wrong, and after the last semicolon the remedy.
        place: place in the file, by default "row 3" or "line 1"; empty for the file as a whole.
        row: number of the row as the file counts rows, or None.
        kind: the file and the remedy, which repeated faults of one kind have in common; the folder where
            ``file_per_row``, as the other rows are in files beside it.
    """

    def __init__(
        self,
        file: str | Path,
        text: str,
        *,
        row: int | None = None,
        line: int | None = None,
        place: str = "",
        file_per_row: bool = False,
    ) -> None:
        super().__init__(file, text)
        self.file, self.text, self.row = Path(file), text, row
        self.place = place or (f"row {row}" if row is not None else f"line {line}" if line is not None else "")
        self.kind = (str(self.file.parent if file_per_row else file), text.rpartition("; ")[2])

    def __str__(self) -> str:
        """The line."""
        return ": ".join(part for part in (str(self.args[0]), self.place, self.text) if part)


class BackendError(RuntimeError):
    """No usable LLVM or CUDA: one line that names what was found and the remedy.

    >>> from wrf_mi.backend import init
    >>> try:
    ...     backend = init()
    ... except BackendError as error:
    ...     print(error)
    """


class LibraryVariableError(BackendError, InputError):
    """An environment variable that names no usable library: one line with the variable, its path and the remedy."""
