"""Blocks against what merging near states loses, for one model and several numbers epsilon."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction

from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.plan import plan_mdp
from factored_polca.models import Model, TaskHierarchy, flat_task
from factored_polca.symbolic import SymbolicModel, compile_model


@dataclass(frozen=True)
class TradeOff:
    """A plan with states within `epsilon` merged, its state being seen; losses are in units of reward.

    `blocks` and `root_blocks` are those of all tasks and of the root; `root_loss` is the bound on the
    root's loss given its children's policies, `task_loss` the largest such bound of any task; `loss` bounds
    what the polled policy loses against any policy, hierarchical or not; `measured` is that loss, and
    `optimum` the flat optimum, None where the exact quotients are too large.
    """

    epsilon: float
    blocks: int
    root_blocks: int
    root_loss: float
    task_loss: float
    loss: float | None
    measured: float | None
    optimum: float | None


def trade_off(
    model: Model,
    tasks: TaskHierarchy | None,
    epsilons: Iterable[Fraction | float | str],
    options: Options | None = None,
) -> list[TradeOff]:
    """Plans with each of some numbers epsilon; where the model's state is not seen, as if it were.

    Raises:
        ModelError: see `factored_polca.hierarchy.plan_mdp`.
        LimitReached: memory, blocks or time.
    """
    options = replace(options or Options(), assume_observed=True)
    hierarchy = tasks or flat_task(model)
    symbolic = compile_model(
        model, order=options.order, tasks=hierarchy, memory_limit=options.memory_limit,
        deadline=options.deadline,
    )  # fmt: skip
    return [_point(model, hierarchy, replace(options, merge_within=e), symbolic) for e in epsilons]


def _point(model: Model, tasks: TaskHierarchy, options: Options, symbolic: SymbolicModel) -> TradeOff:
    found = plan_mdp(model, tasks, options, symbolic=symbolic)
    approximations = [one.approximation for one in found.solved if one.approximation is not None]
    root, whole = approximations[-1], found.certified
    optimum = None if found.flat is None else found.flat.value
    return TradeOff(
        float(root.epsilon),
        sum(one.blocks or 0 for one in found.solved),
        found.root.blocks or 0,
        root.loss,
        max(one.loss for one in approximations),
        None if whole is None else whole.loss,
        None if optimum is None else max(optimum - found.polled.value, 0.0),
        optimum,
    )
