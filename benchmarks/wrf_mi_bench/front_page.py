"""Main table of the documents, ``python -m wrf_mi_bench.front_page`` prints it: a line for each question.

Its figures are entries of the table of radio fields. Columns with and without a scene are apart.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from wrf_mi.apps.table.entries import ALL_ROWS, Entry, read_entries, rows_in_words

from .declared import pivoted
from .entries import OPEN
from .table_pages import STORED as ENTRIES

COLUMNS = {"hybrid": "hybrid, scan", "ray-tracing": "ray tracing, scan", "wrf-gs+-joint": "WRF-GS+, scan"}
SCENE = tuple(COLUMNS)  # methods that have a scene; the others have none
COLUMNS |= {"wrf-gs+": "WRF-GS+, no scan", "kriging": "kriging", "idw": "IDW", "constant": "constant"}
CALIBRATED = {f"ray-tracing-{how}": "ray-tracing" for how in ("calibrated", "materials", "corrected")}
"""Ray tracing is the best of the scene as made, calibrated and corrected by the training rows."""
NONE = "no scan"  # cell of methods with a scene where there is none


class Question(NamedTuple):
    """Line of the table: question, data set, split and number of training rows."""

    text: str
    dataset: str
    split: str = "official"
    share: int | float = ALL_ROWS

    @property
    def data(self) -> str:
        """Arguments of ``wrf-mi train``."""
        words = [self.dataset] + ([] if self.split == "official" else ["--split", self.split])
        words += ["--n-train", str(self.share)] if isinstance(self.share, int) else []
        return f"`{' '.join(words)}`"


QUESTIONS = (
    Question("spectra in a region without measurements, scanned room", "laboratory", "blocked"),
    Question("power in a region without measurements, flat with a plan", "flat-ble", "blocked", 400),
    Question("power in the flat from five measured positions", "flat-ble", share=5),
    Question("spectra a few millimetres from measured ones", "rfid-lab"),
)


def medians_of(question: Question, entries: Sequence[Entry]) -> dict[str, float]:
    """Median score by column, mean over seeds, of entries that answer a question."""
    task, by_method = entries[0].of, dict[str, list[float]]()
    for entry in entries:
        # Without a mesh the paths of free space are no ray tracing in a scan, and a hybrid has none.
        if not (entry.dataset in OPEN and (entry.method in SCENE or entry.method in CALIBRATED)):
            by_method.setdefault(entry.method, []).append(float(entry.score["median"]))
    means = {method: float(np.mean(medians)) for method, medians in by_method.items()}
    constant = next(entry.constant for entry in entries if entry.constant)
    medians = {"constant": float(constant["median"])}
    better = max if task.higher_is_better else min
    for method, median in means.items():
        column = CALIBRATED.get(method, method)
        medians[column] = better(medians.get(column, median), median)
    return {column: medians[column] for column in COLUMNS if column in medians}


def question_table(table: Path = ENTRIES) -> str:
    """Markdown table of medians over test rows from a folder of entries, the best of each line bold."""
    rows, entries = [], read_entries(table).values()
    for question in QUESTIONS:
        wanted = question.dataset, question.split, rows_in_words(question.share)
        chosen = [entry for entry in entries if (entry.dataset, entry.split, entry.rows) == wanted]
        chosen = [entry for entry in chosen if entry.seed is not None]
        medians, task = medians_of(question, chosen), chosen[0].of
        best = (max if task.higher_is_better else min)(medians.values())
        without = dict.fromkeys(SCENE, NONE) if question.dataset in OPEN else {}
        cells = without | {
            column: f"**{median:.{task.digits}f}**" if median == best else f"{median:.{task.digits}f}"
            for column, median in medians.items()
        }
        facts = {"question": f"{question.text}, {task.label}", "data": question.data}
        rows += [{**facts, "column": column, "cell": cell} for column, cell in cells.items()]
    head, line = "| question | data | ... |", "| {question} | {data} | ... |"
    return pivoted(head, line, "question", "column", "{cell}", COLUMNS)(rows)


if __name__ == "__main__":
    print(question_table())
