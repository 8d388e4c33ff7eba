"""Plan with the largest epsilon whose bounds on the losses of the tasks are small enough.

The root's own loss is against its optimum given its children's policies; where it has one child to call
in each state it loses nothing however bad these are.  So the bound is asked of every task.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction

from factored_polca.approximation.search import Trial, candidates, largest_within
from factored_polca.hierarchy.check import checked
from factored_polca.hierarchy.merging import refuse_unmergeable
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.plan import HierarchicalPlan, plan_mdp, solved_tasks
from factored_polca.hierarchy.pomdp_plan import (
    PomdpPlan,
    plan_pomdp,
    refuse_unplannable,
    solved_pomdp_tasks,
)
from factored_polca.hierarchy.solved import StructuredTask
from factored_polca.hierarchy.symbolic_task import SymbolicPomdpTask
from factored_polca.models import Fault, Model, ModelError, TaskHierarchy, flat_task
from factored_polca.symbolic import compile_model


def plan_within_loss(
    model: Model,
    loss: float,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    progress: Callable[[str, str, int, int], None] | None = None,
) -> tuple[HierarchicalPlan | PomdpPlan, tuple[Trial, ...]]:
    """The plan with the largest `merge_within` each of whose tasks surely loses at most `loss`; all trials.

    The loss of a task is at the initial belief, in units of its reward, against its optimum given its
    children's policies.  Each trial plans the tasks anew.

    Raises:
        ModelError: the model or the hierarchy is not right; not even exact abstraction promises that.
        LimitReached: memory, blocks, observations or time.
    """
    options = options or Options()
    refuse_unmergeable(model, options)
    seen = model.observability == "full" or options.assume_observed
    if not seen:
        refuse_unplannable(model)
    hierarchy = checked(model, tasks or flat_task(model), assume_observed=options.assume_observed)
    symbolic = compile_model(
        model, order=options.order, tasks=hierarchy, memory_limit=options.memory_limit,
        deadline=options.deadline,
    )  # fmt: skip
    quick = replace(options, flat_block_limit=None)

    def attempt(epsilon: Fraction) -> Trial:
        chosen = replace(quick, merge_within=epsilon)
        if progress is not None:
            progress(f"epsilon {float(epsilon):g}", "plan", 0, 0)
        solve = solved_tasks if seen else solved_pomdp_tasks
        solved = solve(symbolic, hierarchy, chosen, progress)
        losses = [one.approximation.loss for one in solved if one.approximation is not None]
        blocks = [
            one.reduction.partition.blocks
            for one in solved
            if not isinstance(one, (StructuredTask, SymbolicPomdpTask))
        ]
        return Trial(epsilon, sum(blocks), max(losses))

    found, tried = largest_within(candidates(symbolic, seen=seen), loss, attempt)
    if found is None:
        message = f"exact abstraction bounds the tasks' losses by {tried[0].loss:.3g} only, not by {loss:g}"
        raise ModelError([Fault(message, (), "give a larger --loss, or solve to a smaller --gap")])
    final = replace(options, merge_within=found.epsilon)
    work = plan_mdp if seen else plan_pomdp
    best = work(model, hierarchy, final, progress=progress, symbolic=symbolic)
    symbolic.manager.deadline = None  # of planning; the plan may be used for longer
    return best, tried
