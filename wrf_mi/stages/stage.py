"""A stage of a fit, its options, and the state that stages leave to later ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import Record, Split
from ..core.types import FloatArray, IntArray
from ..estimators.model import Fitted, Problem, Session
from ..training.selection import HeldOut


@dataclass(frozen=True)
class State:
    """What the stages up to one have fitted to some rows."""

    problem: Problem  # with the scene that they have edited
    mean: Any = None  # mean of the observations that later stages are about; None: theirs
    fitted: Fitted | None = None  # prediction; None: no stage predicts yet
    #: split whose test rows are held out of the fit, by which a training may choose its steps; None: none are
    fold: Split | None = None
    kept: Mapping[str, Any] = field(default_factory=dict)  # what a stage needs to go on with all rows, by its name


class Option(NamedTuple):
    """A way to fit a stage, by name."""

    name: str
    fit: Callable[[State, Split, Session], State]  # state with the stage, fitted to the rows of a split
    #: Options of equal freedom compete by their mean score of held-out rows; one of more freedom is taken where its
    #: gain is clear (`wrf_mi.training.gains.last_gain`).
    freedom: int = 0
    #: option that it goes on from: it is tried where that one is not clearly behind another, and where that one has
    #: itself gained, if it goes on from a third
    after: str = ""


class Stage(ABC):
    """A stage of a fit."""

    name: str  # name in reports

    @abstractmethod
    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Its options, the default one first, which later stages of a trial are fitted by; none: it does not apply."""

    def confidence(self, rows: int) -> float | None:
        """One-sided confidence by Student's t in a gain over the default that so many held-out rows have to give.

        None: options of the default's freedom compete with it by their mean, others gain by a standard error.
        """
        return None

    def judging(self, split: Split, row: IntArray) -> NDArray[np.bool_]:
        """Which held-out rows [q] judge the options of a fit to a split; all but those that its fits have seen."""
        return np.ones(len(row), bool)

    def judged(self, record: Record, split: Split, held_out: HeldOut, mean: NDArray[Any]) -> NDArray[Any]:
        """What predictions [q, ...] of held-out rows of a split are judged by: their observations [q, ...]."""
        return held_out.observed(record)

    def continued(self, option: Option, chosen: State, scores: Mapping[str, FloatArray]) -> Option:
        """An option for all rows, given the state that the rows of a fold led to.

        ``scores`` are those of the held-out rows by the options that were tried.
        """
        return option

    def finish(self, state: State, split: Split, session: Session) -> State:
        """The state of all stages with what no option is judged by, such as deviations."""
        return state
