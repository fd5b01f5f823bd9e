"""Short tables of results for `docs/speed.md`; `benchmarks/results/README.md` has all their rows."""

from collections.abc import Sequence

from wrf_mi.runs.sweep import markdown_table

from .comparison import Row

FIT, STEP = ", fit to its final accuracy", ", a step of "
SPECTRUM = "ms of one spectrum, "


def operator(rows: Sequence[Row]) -> str:
    """Milliseconds of a spectrum by splatting and by operator."""
    lines = []
    for row in rows:
        if row["what"].startswith(SPECTRUM):
            parts = dict(part.split(" ", 1) for part in row["value"].replace("operator, 64", "batch").split("; "))
            cells = (parts.get(name, "").partition(" (")[0] for name in ("both", "operator", "batch"))
            lines.append([row["what"].removeprefix(SPECTRUM), *cells])
    return markdown_table(["ms of a spectrum", "splatted", "operator", "operator, 64 at once"], lines)


def training(rows: Sequence[Row]) -> str:
    """Time and peak memory of a fit, its score, and the time of a step of one and of four transmitters."""
    values = {row["what"]: row["value"] for row in rows}
    lines = []
    for what, value in values.items():
        if what.endswith(FIT):
            model, (times, memory, score) = what.removesuffix(FIT), value.split("; ")
            steps = (values.get(f"{model}{STEP}{count}", "") for count in ("1 transmitter", "4 transmitters"))
            ms = (step.partition(" (")[0] for step in steps)
            lines.append([model, times.partition(",")[0], memory, score.rpartition(" ")[2], *ms])
    return markdown_table(["model", "fit", "memory", "median SSIM", "ms of a step of 1", "of 4"], lines)
