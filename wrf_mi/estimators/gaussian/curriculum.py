"""Trainings of a fit beside the paths of a scene: of paths, of Gaussians on surfaces, of the field's Gaussians."""

from __future__ import annotations

from collections.abc import Callable

from ...training.fit_plan import FitPlan
from ...training.gains import last_gain
from ...training.trainer import Trainer


def fit_curriculum(
    plan: FitPlan,
    trainer_of: Callable[[FitPlan, Trainer | None], Trainer] = lambda plan, before: Trainer(
        plan.record, plan.split, plan.config, plan=plan, before=before
    ),
    run: Callable[[Trainer], object] = Trainer.run,
) -> Trainer:
    """Run the trainings of a plan's curriculum, and the chosen one to its last step with all rows.

    Args:
        plan: plan of the first training.
        trainer_of: the trainer of a plan, given that of the training before.
        run: runs a trainer.

    Returns:
        The last training whose scores of held-out rows improve on those of the one kept before it.
    """
    trainers = list[Trainer]()
    for number in range(len(plan.curriculum)):
        trainer = trainer_of(plan.part(number) if number else plan, trainers[-1] if trainers else None)
        trainer.until_chosen = plan.chooses and len(plan.curriculum) > 1
        run(trainer)
        trainers.append(trainer)
    chosen = trainers[-1]
    if chosen.until_chosen:
        scores = ((trainer, trainer.state.best_scores) for trainer in trainers)
        chosen, seconds = last_gain(scores, chosen.higher_is_better), chosen.seconds
        chosen.until_chosen, chosen.seconds = False, seconds
        run(chosen)
    return chosen
