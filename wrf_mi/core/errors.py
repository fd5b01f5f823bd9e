"""Errors that a user can correct."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Bad input: one line that names the file, the row and the remedy.

    The command prints the line and ends with exit status 2; nothing is half written.
    """


class DataFault(InputError):
    """Fault of a data file: one line with the file, the place in it, what is wrong, and the remedy.

    Attributes:
        file: path of the file or folder.
        text: what is wrong, and after the last semicolon the remedy.
        place: place in the file, such as "row 3" or "line 1"; empty for the file as a whole.
        row: number of the row as the file counts rows, or None.
        kind: the file and the remedy, which repeated faults of one kind have in common.
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
        """Make the fault.

        Args:
            file: path of the file or folder.
            text: what is wrong; the remedy.
            row: number of the row of data.
            line: number of the line of a text file, from 1.
            place: place in the file, by default the row or the line.
            file_per_row: the file holds one row, and the other rows are in files beside it.
        """
        super().__init__(file, text)
        self.file, self.text, self.row = Path(file), text, row
        self.place = place or (f"row {row}" if row is not None else f"line {line}" if line is not None else "")
        self.kind = (str(self.file.parent if file_per_row else file), text.rpartition("; ")[2])

    def __str__(self) -> str:
        """The line."""
        return ": ".join(part for part in (str(self.args[0]), self.place, self.text) if part)


class BackendError(RuntimeError):
    """No usable LLVM or CUDA: one line that names what was found and the remedy."""
