"""``wrf-mi evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import InputError
from .options import Arguments, add_command, add_operator, check_operator
from .output import show_metrics


def add_parser(commands: Any) -> None:
    """Add ``evaluate`` to the commands."""
    parser = add_command(commands, "evaluate", evaluate_command, "score a run on its held-out rows")
    parser.add_argument("run", metavar="RUN", help="run folder")
    text = "score on the test rows of another split that the run was not trained on; nothing is written"
    parser.add_argument("--split", help=text)
    text = (
        "draw how reliable probabilities of coverage are on the test rows, P(level > threshold) against observed share"
    )
    parser.add_argument("--reliability", metavar="FILE.png", help=text)
    add_operator(parser)


def evaluate_command(a: Arguments) -> int:
    """Score a run again."""
    from ..runs.api import evaluate_run

    if a.reliability is not None and a.split is not None:
        raise InputError("evaluate: --reliability is of the run's own test rows; omit --split")
    if a.reliability is not None and Path(a.reliability).suffix.lower() != ".png":
        raise InputError(f"{a.reliability}: the picture is written as .png; give such a name")
    check_operator(a)
    metrics = evaluate_run(a.run, a.split, not a.no_operator)
    if a.reliability is not None:
        metrics["coverage"] = _reliability(Path(a.run), Path(a.reliability))
    show_metrics(metrics, None if a.split else Path(a.run), a.json)
    if a.reliability is not None and not a.json:
        error, score = metrics["coverage"]["error"], metrics["coverage"]["brier"]
        print(f"coverage: observed share off by {error:.3f} on average, Brier score {score:.3f}: {a.reliability}")
    return 0


def _reliability(run: Path, picture: Path) -> dict[str, Any]:
    """Draw the reliability of coverage; its errors and thresholds."""
    from ..core.files import write_figure
    from ..maps.coverage import reliability_figure, run_reliability

    found = run_reliability(run)
    write_figure(picture, reliability_figure({run.resolve().name: found}))
    return {"error": found.error, "brier": found.brier, "threshold_db": found.threshold_db.tolist()}
