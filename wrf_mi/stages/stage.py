"""A stage of a fit, its options, and the state that stages leave to later ones."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ..core import Split
from ..models.model import Fitted, Problem, Session


@dataclass(frozen=True)
class State:
    """What the stages up to one have fitted to some rows."""

    problem: Problem  # with the scene that they have edited
    mean: Any = None  # mean of the observations that later stages are about; None: theirs
    fitted: Fitted | None = None  # prediction; None: no stage predicts yet


class Option(NamedTuple):
    """A way to fit a stage, by name."""

    name: str
    fit: Callable[[State, Split, Session], State]  # state with the stage, fitted to the rows of a split
    #: Options of equal freedom compete by their mean score of held-out rows; one of more freedom is taken where its
    #: gain is clear (`wrf_mi.training.selection.last_gain`).
    freedom: int = 0


class Stage(ABC):
    """A stage of a fit."""

    name: str  # name in reports
    trusts_default: bool = False  # whether few rows have to show a clear gain for another option than the default

    @abstractmethod
    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Its options, the default one first, which later stages of a trial are fitted by; none: it does not apply."""

    def continued(self, option: Option, chosen: State) -> Option:
        """An option for all rows, given the state that the rows of a fold led to."""
        return option

    def finish(self, state: State, split: Split, session: Session) -> State:
        """The state of all stages with what no option is judged by, such as deviations."""
        return state
