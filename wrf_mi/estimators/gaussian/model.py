"""The models of 3D Gaussians: ``wrf-gs``, ``wrf-gs+`` and ``factorised``, trained step by step for every task.

With a scene its paths are trained in the same graph (`wrf_mi.graph.graph`); the graph of paths without Gaussians
calibrates `wrf_mi.estimators.ray_tracing`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from ...backend.device import release_memory
from ...core import Antenna, InputError, Prediction, Receiver, Split
from ...core.settings import names_of
from ...core.stored import NOT_STORED
from ...graph.graph import Graph
from ...graph.settings import TRACED_NAMES
from ...receivers.registry import GAPS, ObservationSpec
from ...tasks import TASKS
from ...tasks.conditions import placed_receivers, scene_carrier
from ...tracing.options import without_effect
from ...tracing.paths.edited_scene import parameters_in
from ...training.by_distance import Reach
from ...training.checkpoint import CHECKPOINT, LOG, append_log, cut_log, read_checkpoint, write_checkpoint
from ...training.config import PRESETS, TrainConfig, unused_of_loop, validates
from ...training.events import EVENTS
from ...training.fields import check_params, field_of
from ...training.fit_plan import FitPlan
from ...training.initial import initial_gaussians, starting_values
from ...training.loop import FitState, Progress
from ...training.predictor import Predictor
from ...training.trainer import Trainer
from ...training.validation import HeldOutObservations
from ..model import Decomposition, Fitted, Inputs, Model, Problem, Session
from .curriculum import fit_curriculum
from .new_receivers import Params, of_all_receivers, trained_part, without_rows

SOURCE = "Wen, Tong, Hu, Lin and Zhang, 'Neural representation for wireless radiation field reconstruction' (WRF-GS+)"
PARAM = "params/"  # prefix of a parameter's array in ``model.npz``


def placed_of(problem: Problem, plan: FitPlan) -> tuple[Receiver, ...]:
    """Receivers of a problem as a plan's graph takes them."""
    return placed_receivers(problem.record, by_uplink=bool(plan.graph.form.features))


@dataclass(eq=False)
class FittedField(Fitted):
    """Trained Gaussians, alone or with the paths of a scene, or trained paths alone.

    Attributes:
        folder: folder in which operators are kept (`wrf_mi.training.evaluator`).
        params: parameters by name.
        form: form of the observations.
        receivers: receivers as the graph takes them.
        reach: region in which the Gaussians are used; None: everywhere.
        phase_error: standard deviation of a reflection's phase in predictions, rad.
        field: field of Gaussians, see `wrf_mi.gaussians`; None: paths alone.
        held_out: predictions of training rows by which its state was chosen; None after loading, or where none were.
    """

    problem: Problem = dataclass_field(metadata=NOT_STORED)
    folder: Path = dataclass_field(metadata=NOT_STORED)
    config: TrainConfig
    params: Params
    form: ObservationSpec
    tx_antenna: Antenna
    receivers: tuple[Receiver, ...]
    reach: Reach | None = None
    phase_error: float = 0.0

    def __post_init__(self) -> None:
        self.held_out: HeldOutObservations | None = None
        if self.reach is not None and np.isnan(self.reach.length_m):
            raise InputError("array reach/length_m: not a number; train the run anew")
        # Of Gaussians that no held-out row gained by, nothing is stored and nothing evaluated.
        used = self.problem.scene is None or "position" in self.params
        self.field = field_of(self.config, self.form) if used else None
        check_params(self.field, self.params, str(self.folder / "model.npz"))
        self.uses_heading = self.form.headings
        self.carriers_hz = np.zeros(0) if self.form.carriers_hz is None else self.form.carriers_hz

    @cached_property
    def predictor(self) -> Predictor:
        """``predictor(tx_pos_m, receiver)`` gives spectra [m, H, W], powers [m] or channels [m, ...]."""
        form, config, problem = self.form, self.config, self.problem
        scene = None if problem.scene is None else problem.open_scene(form.carrier_hz)
        graph = Graph(self.field, self.receivers, form, scene, config.traced, self.tx_antenna, config.evaluation)
        graph.add_surface_gaussians((), self.params)
        return Predictor(graph, self.params, problem.operator, self.folder, self.reach, self.phase_error)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of the receiver of that index, [m, ...]."""
        heading = inputs.tx_heading_rad if self.uses_heading else None
        return Prediction(self.predictor(inputs.tx_pos_m, receiver, inputs.uplink, heading, inputs.carriers_hz))

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Observations, and with a scene the paths' and the Gaussians' share of them."""
        if self.problem.scene is None:
            return super().decompose(inputs, receiver, std)
        heading = inputs.tx_heading_rad if self.uses_heading else None
        predicted, paths = self.predictor.decompose(inputs.tx_pos_m, receiver, heading, inputs.carriers_hz)
        return Decomposition(
            Prediction(predicted["prediction"]), predicted.get("traced"), predicted.get("learned"), paths
        )

    def facts(self) -> dict[str, Any]:
        """Steps of the training and number of Gaussians."""
        gaussians = {} if self.field is None else {"gaussians": int(self.params["position"].shape[1])}
        phases = {"phase_error": self.phase_error} if self.phase_error else {}
        return {"steps": self.config.steps} | gaussians | phases

    def in_scene(self, scene: str) -> Fitted:
        """Paths of an edited scene with the fitted parameters of its surfaces; Gaussians of the field stay."""
        if self.problem.scene is None:
            return super().in_scene(scene)
        edited = replace(self.problem, scene=scene, material=None)
        opened, fitted_scene = (problem.open_scene(self.form.carrier_hz) for problem in (edited, self.problem))
        try:
            params = parameters_in(opened, fitted_scene, self.params)
        except InputError as error:
            raise InputError(f"{scene}: {error}; trained in {self.problem.scene}") from None
        return replace(self, problem=edited, params=params)

    def without_gaussians(self) -> FittedField:
        """The same paths without the Gaussians beside them."""
        params = {name: values for name, values in self.params.items() if name.startswith(TRACED_NAMES)}
        return replace(self, params=params, reach=None)


def _fitted(
    plan: FitPlan, params: Params, problem: Problem, folder: Path, reach: Reach | None = None, phase_error: float = 0.0
) -> FittedField:
    form, antenna, receivers = plan.graph.form, problem.record.tx_antenna, placed_of(problem, plan)
    return FittedField(problem, folder, plan.config, params, form, antenna, receivers, reach, phase_error)


def _used(trainer: Trainer) -> tuple[Params, Reach | None]:
    """Parameters and reach of a fit, beside paths without the Gaussians that are not used."""
    params, reach, graph = trainer.state.mean_params(), trainer.reach(), trainer.graph
    if graph.scene is None:
        return params, reach
    # What was not trained is not stored: it would be evaluated in every prediction.
    if not trainer.plan.trains_surfaces:
        params = {name: values for name, values in params.items() if not name.startswith("surface.")}
    if graph.field is not None and reach is not None and reach.length_m == 0:
        return {name: values for name, values in params.items() if name.startswith(TRACED_NAMES)}, None
    return params, reach


def _folder(session: Session, plan: FitPlan) -> Path:
    """Folder of the checkpoint and log of a training; the last one of a curriculum has the session's."""
    last = plan.number == len(plan.curriculum) - 1
    return session.folder if last else session.folder / plan.trains


def _scene(problem: Problem, split: Split) -> Any | None:
    """The scene at the carrier, or at the middle one of the training rows."""
    if problem.scene is None or problem.record.carriers_hz is None:
        return problem.opened_scene
    return problem.open_scene(scene_carrier(problem.record, split.all_train))


def _unused_of_gaussians(plan: FitPlan, name: str) -> dict[str, str]:
    """Settings of Gaussians, their networks, start and density control without effect in a fit, and why."""
    s, task, field = plan.config, plan.task, plan.graph.field
    assert field is not None
    unused: dict[str, str] = {}
    for group in ("opacity", "signal"):
        if group not in field.per_gaussian:
            unused |= {f"optimiser.{group}": f"Gaussians of {name} have no static {group}"}
    if "opacity" not in field.per_gaussian:
        of_opacity = ("initial.opacity", "density.reset_every")
        unused |= dict.fromkeys(of_opacity, f"Gaussians of {name} have no static opacity")
    if name == "factorised":
        unused |= dict.fromkeys(("encoding.position_octaves", "encoding.position_scale_m"), "Gaussians are not encoded")
    else:
        unused["network.terms"] = f"{name} has none"
    if name != "wrf-gs+":
        unused["network.static_geometry"] = f"{name} always moves signals alone"
    if not plan.graph.kind.levels:
        unused["optimiser.level"] = "the receiver model has no level"
    if plan.graph.form.features:
        unused |= dict.fromkeys(
            ("encoding.tx_octaves", "encoding.tx_scale_m"), "transmitters are known by their uplink"
        )
    if s.loss.name:
        unused["loss.ssim_weight"] = f"of the loss of {task.name}, in whose place loss.name is"
    if not task.image:
        unused["loss.ssim_weight"] = f"of images, and the data hold {task.name}"
    unused |= {"view": "observations are spectra, with directions of their own"} if task.image else {}
    if not task.is_complex:
        unused["view.components"] = f"of channels, and the data hold {task.name}"
    if source := next((name for name in ("points", "mesh", "paths") if getattr(s.initial, name)), None):
        random = ("size_deg", "nearest_m", "farthest_m")
        unused |= {f"initial.{name}": f"Gaussians start from initial.{source}" for name in random}
    if not s.density.every:
        unused |= {f"density.{name}": "density.every=0" for name in names_of(type(s.density)) - {"every"}}
    elif not plan.part(len(plan.curriculum) - 1).schedule.density:
        rounds = ("growth_fraction", "max_gaussians", "reset_every")
        text = f"no round follows within {s.steps} steps by density.every={s.density.every}, .start and .stop"
        unused |= {f"density.{name}": text for name in rounds}
    return unused


def _unused_of_paths(plan: FitPlan, splits: Sequence[Split]) -> dict[str, str]:
    """Settings of traced paths without effect, and of validation without rows."""
    if plan.graph.scene is None:
        return unused_of_loop(plan.config, validates(splits)) | {"traced": "paths of a scene are traced; give --scene"}
    traced = plan.config.traced
    unused = without_effect(traced.options)
    unused |= {} if traced.pattern_degree else {"pattern": "pattern_degree is 0"}
    unused |= {} if traced.pattern else {"pattern_degree": "pattern is 0, so patterns are not trained"}
    unused |= {} if traced.material else {"materials": "material is 0, so materials are not trained"}
    unused |= {} if traced.surface else {"surface_spacing": "surface is 0, so there are no Gaussians on surfaces"}
    return {f"traced.{name}": why for name, why in unused.items()}


class GaussianField(Model):
    """A model of 3D Gaussians, of `wrf_mi.gaussians.FIELDS`, for any task or for data of one."""

    source, settings, fitted = SOURCE, TrainConfig, FittedField
    tasks = ("spectrum", "rssi", "csi")
    scene, uplink = "optional", "optional"
    several_carriers, new_receivers = True, True
    gaps = (*GAPS, "length_m")  # an infinite reach
    train_arguments = ("model", "seed", "deterministic", "receiver", "evaluation")
    presets = PRESETS

    def __init__(self, name: str, summary: str, task: str | None = None, with_scene: bool = False) -> None:
        self.name, self.summary = name, summary
        if task is not None:
            # A training step evaluates all pixels of a spectrum at once, so that none may be missing.
            self.complete = TASKS[task].complete
            self.defaults = TASKS[task].settings_with_scene if with_scene else TASKS[task].settings

    def serves(self, task: str) -> bool:
        """Whether a receiver model observes the task, also one of another package."""
        return bool(TASKS[task].receiver)

    def serving(self, task: str, with_scene: bool) -> Model:
        """The model with its default settings for data of a task, with or without a scene."""
        return GaussianField(self.name, self.summary, task, with_scene) if self.serves(task) else self

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedField:
        """Train from the last checkpoint, or from the start, to the last step.

        Raises:
            Interrupted: stopped between two steps; the checkpoint is written.
            NumericsError: a value that is not finite.
        """
        # Receivers without rows would have parameters that nothing trains: they get those of the others afterwards.
        plan = self._plan(problem, split)
        trainer = fit_curriculum(plan, partial(self._trainer, session), partial(self._run, session))
        fitted = self._finished(trainer, problem, split, session)
        del trainer, plan
        release_memory()
        return fitted

    def train_part(
        self, before: Trainer | None, problem: Problem, split: Split, session: Session
    ) -> tuple[FittedField, Trainer]:
        """The first training of the curriculum, or the one that goes on from ``before``.

        The validation rows of a split choose its state.

        Raises:
            Interrupted, NumericsError: as `fit`.
        """
        if before is not None:
            plan = before.plan.part(before.plan.number + 1)
        else:
            (record, rows), scene = trained_part(problem.record, split), _scene(problem, split)
            plan = FitPlan(record, rows, problem.settings, scene=scene, held_out=True)
        trainer = self._trainer(session, plan, before)
        trainer.until_chosen = True
        self._run(session, trainer)
        return self._fitted(trainer, problem, split, session.folder), trainer

    def continued(
        self, trainer: Trainer, scene: str | None, problem: Problem, split: Split, session: Session
    ) -> FittedField:
        """The training of `train_part` in a ``scene`` goes on with all rows of a split, in the scene of a problem."""
        record, before = problem.record, trainer.plan.graph.receivers
        stopped = (_folder(session, trainer.plan) / CHECKPOINT).exists()
        placed = placed_receivers(record, by_uplink=False)
        if problem.scene == scene and [each.name for each in placed] == [each.name for each in before]:
            if stopped:
                del (
                    trainer.plan.traced_fields
                )  # traced anew, as paths are searched where the stopped training searched last
                trainer = self._trainer(session, trainer.plan, None)
            trainer.until_chosen = False
        else:
            names = [each.name for each in before]
            order = [names.index(each.name) for each in placed if each.name in names]
            new = tuple(number for number, each in enumerate(placed) if each.name not in names)
            assert order == sorted(order), "a fold leaves receivers out, and moves none"
            params, _ = of_all_receivers(trainer.state.mean_params(), None, placed, new)
            plan = self._plan(problem, split).part(trainer.plan.number)
            chosen, trainer = trainer, self._trainer(session, plan, None)
            if not stopped:
                trainer.go_on_from(chosen, params)
                trainer.seconds = chosen.seconds
        self._run(session, trainer)
        return self._finished(trainer, problem, split, session)

    def as_traced(self, problem: Problem, split: Split, session: Session) -> FittedField:
        """The paths of a scene without any training, with the gains that training would start from."""
        plan = self._plan(problem, split)
        # Without a gain no row has to be traced.
        params = starting_values(plan) if plan.task.has_gain else {}
        return _fitted(plan, params, problem, session.folder)

    def _trainer(self, session: Session, plan: FitPlan, before: Trainer | None) -> Trainer:
        """A trainer of a plan, at the last checkpoint in its folder or at the start."""
        folder = _folder(session, plan)
        folder.mkdir(parents=True, exist_ok=True)
        stored = read_checkpoint(folder) if (folder / CHECKPOINT).exists() else None
        state = None if stored is None else FitState.from_arrays(stored)
        trainer = Trainer(plan.record, plan.split, plan.config, state=state, plan=plan, before=before)
        if stored is not None:
            trainer.seconds = float(stored["seconds"])
        cut_log(folder, trainer.state.step)  # a killed run has logged steps after its checkpoint
        return trainer

    def _run(self, session: Session, trainer: Trainer) -> None:
        """Train to the end (Interrupted: stopped before)."""
        folder, steps = _folder(session, trainer.plan), trainer.config.steps
        what = "training" if len(trainer.plan.curriculum) == 1 else f"training {trainer.plan.trains}"

        folder.mkdir(parents=True, exist_ok=True)

        def on_progress(progress: Progress) -> None:
            append_log(folder, progress)
            session.on_progress(what, progress.step / steps, progress)

        if not trainer.run(on_progress, partial(write_checkpoint, folder, trainer), session.stop):
            raise session.interrupted(f"after step {trainer.state.step} of {steps}")

    def _finished(self, trainer: Trainer, problem: Problem, split: Split, session: Session) -> FittedField:
        """The field after the last step of the chosen training, whose log is that of the fit."""
        folder = _folder(session, trainer.plan)
        for name in (LOG, EVENTS):
            if folder != session.folder and (folder / name).exists():  # a resumed fit may have moved it before it ended
                (folder / name).replace(session.folder / name)
        session.discarded.extend(session.folder / name for name in trainer.plan.curriculum[:-1])
        return self._fitted(trainer, problem, split, session.folder)

    def _fitted(self, trainer: Trainer, problem: Problem, split: Split, folder: Path) -> FittedField:
        params, reach = of_all_receivers(*_used(trainer), placed_of(problem, trainer.plan), without_rows(split))
        fitted = _fitted(trainer.plan, params, problem, folder, reach, float(trainer.state.phase_error))
        fitted.train_seconds, fitted.held_out = trainer.seconds, trainer.validation.held_out_observations(trainer.state)
        return fitted

    def _plan(self, problem: Problem, split: Split) -> FitPlan:
        """Plan of a fit, taken from `check` where data, rows, settings and scene are the same."""
        (record, rows), scene = trained_part(problem.record, split), _scene(problem, split)
        config, plans = problem.settings.resolved(record.tx_pos_m[rows.all_train]), list[FitPlan](problem.checked)
        problem.checked.clear()  # a training changes the graph of its plan
        for plan in plans:
            same = plan.record is record and plan.config == config and plan.graph.scene is scene
            parts = (plan.split.train, rows.train), (plan.split.validation, rows.validation)
            if same and all(np.array_equal(*part) for part in parts):
                return plan
        return FitPlan(record, rows, problem.settings, scene=scene)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse settings, files and scenes that a training would refuse."""
        # The last plan that is made is that of the part that is fitted first: plans of all would be in memory together.
        for split in reversed(splits):
            # The first part of a fit, which takes no time: what it refuses is refused before a run folder exists.
            plan = self._plan(problem, split)
            drawn = np.random.default_rng([plan.config.seed, 0])
            placed = replace(plan.record, receivers=plan.graph.receivers)
            initial_gaussians(plan.config.initial, placed, plan.split.train, drawn)
            problem.checked.append(plan)

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of other fields and tasks, of paths without a scene, of starts and rounds that are not made."""
        plan: FitPlan = problem.checked[-1] if problem.checked else self._plan(problem, splits[-1])
        return _unused_of_gaussians(plan, self.name) | _unused_of_paths(plan, splits)

    def prepare(self, problem: Problem, splits: Sequence[Split], session: Session) -> TrainConfig:
        """Settings with number of steps and scale of transmitters resolved."""
        config: TrainConfig = problem.settings
        return config.resolved(problem.record.tx_pos_m[np.concatenate([rows.all_train for rows in splits])])


WRF_GS = GaussianField("wrf-gs", "3D Gaussians with complex attenuation, signals by networks")
WRF_GS_PLUS = GaussianField("wrf-gs+", "3D Gaussians with static attributes and a deformation network")
FACTORISED = GaussianField(
    "factorised", "static 3D Gaussians, signals are mixtures of a few functions of the transmitter"
)
