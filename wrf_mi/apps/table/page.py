"""Page of the table of radio fields: questions, data sets and methods, with simple models and papers' figures."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ...core.yaml_files import read_yaml
from ...runs.baselines import CONSTANT
from ...runs.figures import time_scatter
from ...runs.page import definitions, document, escaped, picture, sorted_table
from ...runs.results import reference_words
from .entries import ALL, Entry, read_entries
from .sources import Source, read_sources

PUBLISHED = "published.yml"  # file of the figures that papers state, in the folder of the entries
REGIONS, FEW, RECEIVERS = "Regions without measurements", "Few measurements", "Receivers without measurements"
CARRIERS, BUILDINGS = "Carriers without measurements", "Measured buildings, other walks"
AMONG = "Positions among the measured ones"
QUESTIONS = (REGIONS, FEW, RECEIVERS, CARRIERS, BUILDINGS, AMONG)
SIMPLE = frozenset(("constant", "idw", "kriging", "trees", "mri", "linear", "carrier", "reference"))
"""Methods without any knowledge of waves, beside which others are shown."""
COLUMNS = {"method": "method", "rank": "rank", "median": "median", "mean": "mean", "interval": "95 % of the mean"}
COLUMNS |= {"bias": "bias (dB)", "rmse": "RMSE (dB)", "p10": "p10", "p90": "p90", "inside_90": "inside 90 %"}
COLUMNS |= {"seeds": "seeds", "n_train": "training rows", "n_test": "test rows", "train_seconds": "fit (s)"}
COLUMNS |= {"ms_per_sample": "a row (ms)", "peak_memory_mb": "memory (MB)", "machine": "machine", "date": "date"}
COLUMNS |= {"code": "code", "licence": "licence", "predictions": "predictions (SHA-256)"}
TEXTS = frozenset(("method", "interval", "machine", "date", "code", "licence", "predictions"))
SHOWN_DIGITS = 12  # hexadecimal digits of a digest
Group = tuple[str, str, str]  # data set, split, training rows in words


def question_of(entry: Entry, sources: Mapping[str, Source]) -> str:
    """Question that an entry answers, by its split, its number of rows and its data."""
    by_split = {"blocked": REGIONS, "receiver": RECEIVERS, "frequency": CARRIERS, "frequency-known": CARRIERS}
    if (kind := entry.split.partition(":")[0].partition("+")[0]) in by_split:
        return by_split[kind]
    if entry.rows != ALL:
        return FEW
    source = sources.get(entry.dataset)
    return BUILDINGS if source is not None and source.building else AMONG


def group_rows(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Rows of the table of a data set, split and number of rows, best median first; seeds of a method are one row.

    Entries that are pooled over seeds replace those of single seeds. The constant and the references of the entries
    are rows, too, unless a method is the reference itself.
    """
    task, by_method = entries[0].of, dict[str, list[Entry]]()
    for entry in entries:
        by_method.setdefault(entry.method, []).append(entry)
    rows = []
    for seeds in by_method.values():
        used = [entry for entry in seeds if entry.seed is None] or seeds
        rows.append(_row(used))
    first = next((entry for entry in entries if entry.constant), None)
    row_counts = {"n_train": entries[0].n_train, "n_test": entries[0].n_test}
    if first is not None and first.constant:
        rows.append(row_counts | _scores(first.constant) | {"method": f"constant: {first.constant.get('words', '')}"})
        if first.constant_rmse:
            rows[-1] |= {key: first.constant_rmse.get(key) for key in ("bias", "rmse")}
        rows[-1]["kind"] = "constant"
    references = next((entry.reference for entry in entries if entry.reference), None) or {}
    for key, block in references.items():
        plain = key.rstrip("0123456789")  # earlier entries name IDW with its number of neighbours
        if plain not in by_method:
            words = reference_words(task, dict(references), key) if key in task.references else key
            rows.append(row_counts | _scores(block) | {"method": f"{words} (reference)", "kind": "reference"})
    rows.sort(key=lambda row: float(row["median"]), reverse=task.higher_is_better)
    return [row | {"rank": number} for number, row in enumerate(rows, 1)]


def _row(seeds: Sequence[Entry]) -> dict[str, Any]:
    first = seeds[0]
    row: dict[str, Any] = {"method": first.label, "kind": first.method, "n_train": first.n_train}
    keys = {key for entry in seeds for key in entry.score}
    row |= {key: float(np.mean([entry.score[key] for entry in seeds if key in entry.score])) for key in keys}
    for key in ("inside_90", "train_seconds", "ms_per_sample", "peak_memory_mb"):
        values = [value for entry in seeds if (value := getattr(entry, key)) is not None]
        row[key] = float(np.median(values)) if values else None
    interval = first.mean_interval if len(seeds) == 1 else None
    row["interval"] = None if interval is None else f"{interval[0]:.3g} to {interval[1]:.3g}"
    machine = first.machine
    row["machine"] = machine if machine is None or isinstance(machine, str) else _machine(machine)
    row |= {"seeds": len(seeds), "n_test": first.n_test, "date": max(entry.date for entry in seeds)}
    row |= {"code": first.origin or first.command or first.paper, "licence": first.licence}
    row["predictions"] = first.predictions and first.predictions[:SHOWN_DIGITS]
    return row


def _machine(machine: Mapping[str, Any]) -> str:
    return f"{machine.get('processor', '')}, {machine.get('cores', '?')} cores"


def _scores(block: Mapping[str, Any]) -> dict[str, Any]:
    return {key: block.get(key) for key in ("median", "mean", "p10", "p90", "bias", "rmse")}


def verdict(rows: Sequence[Mapping[str, Any]], label: str) -> str:
    """The best method beside the best simple model and the constant, in words."""
    learned = [row for row in rows if row["kind"] not in SIMPLE]
    simple = [row for row in rows if row["kind"] in SIMPLE and row["kind"] != CONSTANT]
    constant = [row for row in rows if row["kind"] == CONSTANT]
    named = [(words, ranked[0]) for words, ranked in (("best simple model", simple), ("constant", constant)) if ranked]
    beside = "; ".join(
        f"{words}: {row['method'].removeprefix('constant: ')}, {row['median']:.3g}" for words, row in named
    )
    if not learned:
        return beside
    best = learned[0]
    place = "ahead of"
    if simple and f"{simple[0]['median']:.3g}" == f"{best['median']:.3g}":
        place = "level with"
    elif simple and simple[0]["rank"] < best["rank"]:
        place = "behind"
    return f"{best['method']}: median {label} {best['median']:.3g}; {place} the {beside}"


def _figure(rows: Sequence[Mapping[str, Any]], label: str, better: str) -> Figure | None:
    timed = {row["method"]: row for row in rows if row.get("ms_per_sample") and row.get("train_seconds") is not None}
    if len(timed) < 2:
        return None
    panels = {
        words: {name: max(float(row[key]), 1e-3) for name, row in timed.items()}
        for words, key in (("ms per row", "ms_per_sample"), ("fit (s)", "train_seconds"))
    }
    medians = {name: float(row["median"]) for name, row in timed.items()}
    return time_scatter(panels, medians, f"median {label}\n({better} is better)")


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100)
    return stream.getvalue()


def table_page(table: Path) -> str:
    """HTML of the table of a folder of entries: a section for each question, one file without network."""
    entries, sources = read_entries(table).values(), read_sources(table)
    questions: dict[str, dict[Group, list[Entry]]] = {question: {} for question in QUESTIONS}
    for entry in entries:
        groups = questions[question_of(entry, sources)]
        groups.setdefault((entry.dataset, entry.split, entry.rows), []).append(entry)
    asked = {question: groups for question, groups in questions.items() if groups}
    links = " · ".join(f'<a href="#q{number}">{escaped(question)}</a>' for number, question in enumerate(asked))
    body = f"""<h1>Radio fields on the same held-out rows</h1>
<p>Predictions of any program, scored by wrf_mi on fixed test rows, beside the best constant and simple models.
Times are of the machine that is named; compare them on equal ones. Entries come by <code>wrf-mi table add</code>.</p>
<nav>{links} · <a href="#published">Stated by papers</a> · <a href="#data">Data</a></nav>
{"".join(_question(number, *item) for number, item in enumerate(asked.items()))}
<h2 id="published">Stated by papers, for other data</h2>
<p class="note">Not scored here and not comparable with the tables above: compare orders, not figures.</p>
{_published(table)}
<h2 id="data">Data sets</h2>
{_data(sources.values())}"""
    return document("Radio fields on the same held-out rows", body)


def _question(number: int, question: str, groups: Mapping[Group, Sequence[Entry]]) -> str:
    parts = [f'<h2 id="q{number}">{escaped(question)}</h2>']
    for (dataset, split, count), entries in sorted(groups.items()):
        task, rows = entries[0].of, group_rows(entries)
        title = f"{dataset}, {split}, {count}: {task.label}"
        better = "higher" if task.higher_is_better else "lower"
        figure = _figure(rows, task.label, better)
        parts += [f"<h3>{escaped(title)}</h3>", f"<p>{escaped(verdict(rows, task.label))}.</p>"]
        parts.append(f'<div class="flat">{sorted_table(COLUMNS, rows, frozenset(COLUMNS) - TEXTS)}</div>')
        if figure is not None:
            medians = "; ".join(f"{row['method']} {row['median']:.3g}" for row in rows)
            shown = picture(_png(figure), f"Time against error: {dataset}, {split}", f"points of methods: {medians}")
            parts.append(f"<details><summary>Time against error</summary>{shown}</details>")
    return "\n".join(parts)


def _published(table: Path) -> str:
    columns = {"method": "method", "what": "what", "figure": "figure", "data": "data", "paper": "paper"}
    path = table / PUBLISHED
    rows = read_yaml(path)["figures"] if path.exists() else []
    return sorted_table(columns, rows, frozenset())


def _data(sources: Iterable[Source]) -> str:
    facts = {}
    for source in sources:
        rights = "may be passed on" if source.redistributable else "get it from its authors"
        splits = ", ".join(f"{split} {digest}" for split, digest in source.splits.items())
        version = source.observations or "made anew on each machine"
        words = f"{source.licence}, {rights}; {source.origin}; {source.get}; observations {version}; splits {splits}"
        facts[source.name] = words
    return definitions(facts)
