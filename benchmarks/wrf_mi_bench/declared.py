"""Declared Markdown tables of the rows of a result: a line for each row, or pivoted.

Lines and cells are format strings of the entries of a row.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

Entries = Mapping[str, Any]
Table = Callable[[Sequence[Entries]], str]


def markdown(head: str, lines: Sequence[str]) -> str:
    """Table of a heading, ``| a | b |``, and lines of as many cells."""
    return "\n".join([head, f"|{' --- |' * (head.count('|') - 1)}", *lines])


def lined(head: str, line: str, of: Callable[[Any], Entries | None] = dict) -> Table:
    """Table with a line for each row; ``of`` gives the entries that are shown of a row, or None to leave it out."""
    return lambda rows: markdown(head, [line.format_map(entries) for row in rows if (entries := of(row)) is not None])


def pivoted(
    head: str,
    line: str,
    key: str,
    column: str,
    cell: str,
    titles: Mapping[Any, str] | None = None,
    best: Callable[[Sequence[str]], str] | None = None,
) -> Table:
    """Table with a line for each value of the entry ``key``, and a column for each value of the entry ``column``.

    Args:
        head: the heading, a format string of the first of all rows; "..." stands for the columns.
        line: a line, a format string of its first row, likewise.
        key: name of the entry whose values are lines.
        column: name of the entry whose values are columns.
        cell: what a row shows in its line and column.
        titles: title by value of ``column``, in the order of the columns; by default the values themselves.
        best: chooses the text of a line that is bold.
    """

    def table(rows: Sequence[Entries]) -> str:
        heads = titles or {row[column]: row[column] for row in rows}
        lines = []
        for value in dict.fromkeys(row[key] for row in rows):
            of_line = [row for row in rows if row[key] == value]
            texts = {row[column]: cell.format_map(row) for row in of_line}
            bold = best(list(texts.values())) if best else None
            cells = (f"**{text}**" if text == bold else text for text in (texts.get(name, "") for name in heads))
            lines.append(line.format_map(of_line[0]).replace("...", " | ".join(cells)))
        return markdown(head.format_map(rows[0]).replace("...", " | ".join(heads.values())), lines)

    return table
