"""Choice of the posterior's form, of k nearest neighbours and of the mass of regions by held-out training rows.

The run's model is fitted again to the rest of each fold (`folds_of`), predicts at all candidate positions, and locates
the fold's held-out rows. The form with the greatest mean logarithm of the posterior density at the true positions is
chosen: a proper score (Gneiting and Raftery, "Strictly proper scoring rules, prediction, and estimation" (2007), JASA
102), which regions that are too narrow or too wide lower. The probability that regions hold is then that with which the
stated share of the held-out positions lies inside (`wrf_mi.apps.maps.locate_likelihood.mass_of`).
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax
from threadpoolctl import threadpool_limits

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.array_files import stored_arrays, write_arrays
from ...core.files import readable, write_atomically
from ...core.settings import settings_from
from ...core.types import IntArray
from ...datasets.observations import fitted_receivers, predicts_new_runs
from ...estimators.held_out import fit_fold
from ...estimators.interpolation.stretches import folds as stretches_of
from ...estimators.model import Inputs, slices
from ...models import Fitted, Session
from ...runs.folder import load_rows
from ...runs.run import Run
from ...tasks.scores import LEVEL
from ...training.gains import last_gain
from ...training.selection import hold_out
from .grid import HEADINGS, Candidates
from .locate_likelihood import Likelihood, mass_of, ranks_of, region_of
from .locate_neighbours import SPREADS, Neighbours, choose_neighbours, log_near

logger = logging.getLogger(__name__)

SCALES = (0.35, 0.5, 0.7, 0.85, 1.0, 1.2, 1.4, 2.0)  # of the likelihood, to choose from
MOST_ROWS = 300  # most held-out rows that are located
TOGETHER = 512  # candidates that are predicted together
FOLDS = 3  # hold-outs of other rows: one alone has few positions, near each other
FOLDER, FILE = "locate", "locate.json"  # folder of finished folds in the run folder, and file of the choice


@dataclass(frozen=True)
class Calibration:
    """Likelihood and nearest neighbours of a run, with what held-out rows say of them."""

    likelihood: Likelihood  # form of the likelihood
    neighbours: Neighbours | None = None  # nearest neighbours; None: the run has no training rows to compare with
    rows: int = 0  # number of located held-out rows; 0: the form is the default one, as nothing could be held out
    error_m: float = np.nan  # their mean distance from the estimate, metres
    inside: float = np.nan  # share of them inside the regions that hold the probability `LEVEL`
    neighbours_error_m: float = np.nan  # mean distance of them from the nearest neighbours' estimate, metres
    # standard deviation of the density around the neighbours' estimate along an axis, metres; None: the field alone
    spread_m: float | None = None
    denser: tuple[float, ...] = ()  # rank of each held-out row by density (`ranks_of`)
    nearer: tuple[float, ...] = ()  # rank of each by the distance from the estimate
    folds: str = ""  # how rows were held out, in words
    # mean log posterior density at the true positions of each form that was tried, per square metre
    scores: dict[str, float] | None = None

    def probabilities(
        self, of_field: FloatArray, neighbours_m: FloatArray | None, candidates: Candidates
    ) -> FloatArray:
        """Posterior probabilities [p] from the field's log likelihood [p] and the neighbours' estimate [2 or 3]."""
        if self.spread_m is None or neighbours_m is None:
            return np.asarray(softmax(of_field))
        return np.asarray(softmax(of_field + log_near(candidates.positions_m, neighbours_m, self.spread_m)))

    def masses(self, level: float) -> tuple[float, float]:
        """Probabilities that a region and a circle hold whose shares of true positions are the level."""
        return mass_of(self.denser, level), mass_of(self.nearer, level)


def predict_candidates(
    fitted: Fitted, receivers: IntArray, headings: int, candidates: Candidates, progress: Callable[[float], None]
) -> NDArray[np.float32]:
    """Means in dBm and standard deviations in dB [2, headings, n_rx, p] of a fitted model at the candidates.

    Receivers are those of the given numbers [n_rx]; headings are equally spaced where the model uses them.
    `InputError` where it states no standard deviation.
    """
    positions = candidates.positions_m
    predicted = np.empty((2, headings, len(receivers), len(positions)), np.float32)
    progress(0.0)
    # Positions in the outer loop: a chunk's paths to all receivers are traced together and bound the memory.
    for part in slices(len(positions), TOGETHER):
        for number in range(headings):
            turned = np.full(part.stop - part.start, 2 * np.pi * number / headings) if headings > 1 else None
            # Without the offset of an unknown device, which all receivers have in common: the likelihood has it.
            inputs = Inputs(positions[part], turned, runs=np.full(part.stop - part.start, ""))
            for place, receiver in enumerate(receivers):
                prediction = fitted.predict(inputs, int(receiver))
                if prediction.std is None:
                    raise InputError("its model states no standard deviation; train it with --intervals")
                predicted[:, number, place, part] = prediction.mean, prediction.std
        progress(part.stop / len(positions))
    return predicted


def headings_of(run: Run) -> int:
    """Number of headings at which a run's model is evaluated; 1 where it does not use the heading."""
    return HEADINGS if run.takes_heading and run.problem.record.tx_heading_rad is not None else 1


@dataclass(frozen=True)
class Located:
    """Held-out rows of a fold: predictions at the receivers of the given numbers, which have enough training rows in
    the fold (`predict_candidates`); rows of the record [m], the candidate nearest to each [m], and the nearest
    neighbours' estimate of each [m, 3].
    """

    predicted: NDArray[np.float32]
    receivers: IntArray
    rows: IntArray
    truth: IntArray
    neighbours_m: FloatArray


def calibration_of(run: Run, fitted: Fitted, candidates: Candidates, session: Session) -> Calibration:
    """The stored choice of a run for these candidates, else a new one, which is stored in the run folder.

    ``fitted`` is the run's model, which shares what it has traced at the candidates (`Fitted.tracing_once`). Finished
    folds are kept until all are, so that a stopped choice (`Interrupted`) goes on. `InputError` of a fold that the
    model cannot be fitted to.
    """
    grid, file = candidates.grid, run.folder / FILE
    key = {"candidates": int(candidates.inside.sum()), "low_m": [float(grid.x_m[0]), float(grid.y_m[0])]}
    key |= {"high_m": [float(grid.x_m[-1]), float(grid.y_m[-1])], "height_m": grid.height_m, "scales": list(SCALES)}
    if file.exists():
        with readable(file, f"{file}: missing", "remove it"):
            stored = json.loads(file.read_text(encoding="utf-8"))
            if stored.pop("key") == key:
                return settings_from(Calibration, stored, str(file))
    record, split = run.problem.record, load_rows(run.folder, run.problem.record)
    folds, neighbours, words = folds_of(record, split)
    if not folds:
        return Calibration(Likelihood())
    parts, most = [], max(1, MOST_ROWS // len(folds))
    for number, fold in enumerate(folds):

        def progress(share: float, number: int = number) -> None:
            session.progress(f"calibrating by {len(folds)} folds", (number + share) / len(folds))

        progress(0.0)
        folder = run.folder / FOLDER / f"fold{number}"
        receivers, predicted = _predicted_fold(run, fitted, fold, folder, candidates, session, progress)
        test = fold.test[np.isfinite(record.observation[receivers][:, fold.test]).any(axis=0)]
        test = np.sort(np.random.default_rng([run.problem.seed, 11]).permutation(test)[:most])
        near_m = neighbours.locate(record, fold.all_train, np.asarray(record.observation[:, test], float))
        parts.append(Located(predicted, receivers, test, candidates.nearest(record.tx_pos_m[test]), near_m))
    chosen = choose(record, parts, candidates, lambda share: session.progress("choosing the likelihood", share))
    chosen = replace(chosen, neighbours=neighbours, folds=words)
    write_atomically(file, json.dumps({"key": key, **asdict(chosen)}, indent=1) + "\n")
    shutil.rmtree(run.folder / FOLDER, ignore_errors=True)
    return chosen


def _predicted_fold(
    run: Run,
    fitted: Fitted,
    fold: Split,
    folder: Path,
    candidates: Candidates,
    session: Session,
    progress: Callable[[float], None],
) -> tuple[IntArray, NDArray[np.float32]]:
    """Receivers of a fold and predictions at the candidates by a model fitted to it; a finished fit is read.

    A model whose parameters are not the fit is given the fold's rows: fitting a hybrid to each fold takes minutes.
    """
    record = run.problem.record
    if (refit := fitted.refit(record, fold.all_train)) is not None:
        numbers, _ = fitted_receivers(record, [fold])
        return numbers, predict_candidates(refit, numbers, headings_of(run), candidates, progress)
    file = folder.with_suffix(".npz")
    arrays = stored_arrays(file) if file.exists() else {}
    if "predicted" not in arrays or arrays["positions_m"].shape != candidates.positions_m.shape:
        folder.mkdir(parents=True, exist_ok=True)  # with the files of a stopped fit, if any
        # One line for all folds: a fit may have twenty stages.
        inner = replace(session, folder=folder, run=folder, on_progress=lambda *_: progress(0.0))
        with threadpool_limits(1, "blas"):
            of_fold, numbers = fit_fold(run.model, run.problem, fold, inner)
            places = np.arange(len(numbers))
            predicted = predict_candidates(of_fold.tracing_once(), places, headings_of(run), candidates, progress)
        arrays = {"predicted": predicted, "positions_m": candidates.positions_m, "receivers": numbers}
        write_arrays(file, arrays)
        shutil.rmtree(folder)
    return arrays["receivers"], arrays["predicted"]


def folds_of(record: Record, split: Split) -> tuple[list[Split], Neighbours, str]:
    """Hold-outs whose likelihoods are compared, nearest neighbours chosen by them, and how rows are held out, in words.

    Rows are as far from the others as those to be predicted, or of other runs (`hold_out`, with other seeds); or they
    are stretches of the record's order, if nearest neighbours locate these with a greater error: consecutive rows of a
    path share people, doors and the noise of their time, which rows of another day do not. No fold where no rows can
    be held out.
    """
    far = [hold_out(record, replace(split, seed=split.seed + number)) for number in range(FOLDS)]
    kinds = [([fold for fold in far if fold is not None], "as far from the others as predicted positions")]
    if predicts_new_runs(record, split):
        kinds = [(kinds[0][0], "of other runs")]
    else:
        rows = split.all_train
        pairs = list(stretches_of(record.tx_pos_m[rows], FOLDS + 1))[:FOLDS]
        none = np.zeros(0, np.int64)
        stretches = [Split("held out", split.seed, rows[training], none, rows[out]) for training, out in pairs]
        kinds.append((stretches, "in stretches of the data's order"))
    tried = [(folds, words, *choose_neighbours(record, folds)) for folds, words in kinds if folds]
    if not tried:
        return [], Neighbours(1), ""
    folds, words, neighbours, _ = max(tried, key=lambda kind: float(kind[3].mean()))
    return folds, neighbours, words


def choose(
    record: Record, parts: Sequence[Located], candidates: Candidates, progress: Callable[[float], None]
) -> Calibration:
    """The posterior with the best score on held-out rows, and their ranks.

    The scale is chosen first (`widest`), then a density around the nearest neighbours' estimate, the wider the earlier.
    """
    tried = []
    for number, scale in enumerate(SCALES):
        tried.append(np.concatenate([_scores(record, part, Likelihood(scale), candidates) for part in parts]))
        progress((number + 1) / len(SCALES))
    scores = {f"{scale:g} standard deviations": float(each.mean()) for scale, each in zip(SCALES, tried, strict=True)}
    return _with_neighbours(record, parts, candidates, Likelihood(widest(SCALES, tried)), scores)


def _with_neighbours(
    record: Record, parts: Sequence[Located], candidates: Candidates, form: Likelihood, scores: dict[str, float]
) -> Calibration:
    """The posterior of a form of the likelihood with the chosen density around the neighbours' estimate, and ranks.

    Scores of the densities are added to ``scores``.
    """
    truth = np.concatenate([part.truth for part in parts])
    places_m = record.tx_pos_m[np.concatenate([part.rows for part in parts])]
    of_field = [form.log(_strengths(record, part, row), *part.predicted) for part in parts for row in part.rows]
    near_m = np.concatenate([part.neighbours_m for part in parts])
    near_error_m = np.linalg.norm((near_m - places_m)[:, :2], axis=1)
    deviation_m = float(np.sqrt(np.square(near_error_m).mean() / 2)) or 1.0

    def posteriors(spread_m: float | None) -> Iterator[FloatArray]:
        tried = Calibration(form, spread_m=spread_m)
        return (tried.probabilities(log, near, candidates) for log, near in zip(of_field, near_m, strict=True))

    # The wider the density, the less it can do harm; none is the first option.
    options: list[tuple[float | None, FloatArray]] = []
    for spread_m in (None, *(factor * deviation_m for factor in SPREADS)):
        density = np.array([each[place] for each, place in zip(posteriors(spread_m), truth, strict=True)])
        options.append((spread_m, _log_density(density, candidates)))
        if spread_m is not None:
            scores[f"nearest neighbours' estimate within {spread_m:.3g} m"] = float(options[-1][1].mean())
    spread_m = last_gain(options, higher_is_better=True)
    # Errors and ranks by the chosen posterior.
    errors_m, ranks = np.empty(len(truth)), np.empty((len(truth), 2))
    for number, probability in enumerate(posteriors(spread_m)):
        best = region_of(probability, candidates.distance_m, LEVEL)[0]
        errors_m[number] = np.linalg.norm((candidates.positions_m[best] - places_m[number])[:2])
        ranks[number] = ranks_of(probability, candidates.distance_m, best, int(truth[number]))
    return Calibration(
        form,
        rows=len(truth),
        error_m=float(errors_m.mean()),
        inside=float((ranks[:, 0] < LEVEL).mean()),
        neighbours_error_m=float(near_error_m.mean()),
        spread_m=spread_m,
        denser=tuple(ranks[:, 0].tolist()),
        nearer=tuple(ranks[:, 1].tolist()),
        scores=scores,
    )


def _log_density(probability: FloatArray, candidates: Candidates) -> FloatArray:
    """Logarithm of the density per square metre of candidates with probabilities [m]."""
    return np.asarray(np.log(np.maximum(probability, np.finfo(float).tiny)) - np.log(candidates.cell_m2 or 1.0))


def widest(scales: Sequence[float], scores: Sequence[FloatArray]) -> float:
    """The largest scale among those whose scores [m] are within a standard error of the best.

    Held-out rows share the conditions of the training rows, and few of them tell scales apart by chance; the rows to be
    located have errors of another day (Breiman et al., "Classification and regression trees" (1984), section 3.4.3: the
    rule of one standard error).
    """
    best = scores[int(np.argmax([of_scale.mean() for of_scale in scores]))]
    losses = [best - of_scale for of_scale in scores]
    able = [loss.mean() <= loss.std() / np.sqrt(len(loss)) for loss in losses]
    return max(scale for scale, within in zip(scales, able, strict=True) if within)


def _strengths(record: Record, part: Located, row: int) -> FloatArray:
    return np.asarray(record.observation[part.receivers, row], float)


def _scores(record: Record, part: Located, form: Likelihood, candidates: Candidates) -> FloatArray:
    """Log posterior density [m] at the true positions of held-out rows, per square metre."""
    densities = []
    for row, truth in zip(part.rows, part.truth, strict=True):
        log = form.log(_strengths(record, part, row), *part.predicted)
        densities.append(log[truth] - np.logaddexp.reduce(log))
    return np.asarray(densities) - np.log(candidates.cell_m2 or 1.0)
