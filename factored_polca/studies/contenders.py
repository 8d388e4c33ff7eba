"""The policies of Figure 4b, each able to run on one tracker of beliefs.

    PolCA+   the hierarchy planned with observations, polled from the top at each belief
    PolCA    the hierarchy planned as if the state were seen, asked at the likeliest state
    QMDP     no hierarchy: the state as if seen from the next step on (Littman et al. 1995)
    SARSOP   no hierarchy: point-based, with bounds on what any policy can earn (Kurniawati et al. 2008)

All are planned on one compiled model; the tracker's blocks tell apart what any of them does.  The flat ones
are solved on the flat quotient (Eq. 13 with all primitive actions), whose optimum is the model's.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from factored_polca.control.belief_policies import BlockPolicy, FlatPolicy, MostLikelyPolicy, PolledPolicy
from factored_polca.control.block_tracker import BlockTracker, make_block_tracker
from factored_polca.control.tracker import BLOCK_LIMIT, tested_features
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.hierarchy.pomdp_plan import belief_policy, refuse_unplannable
from factored_polca.minimisation import Reduction, flat_process, reduce
from factored_polca.models import Model, TaskHierarchy, flat_task
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.studies.parameters import Progress, as_if_seen, silent
from factored_polca.symbolic import SymbolicModel, compile_model

FLAT_TRIALS = 300
"""Trials of the flat SARSOP: some 15 seconds on the nursing robot."""

FLAT_GAP = 1e-3
"""upper - lower at which it stops earlier."""


@dataclass(frozen=True)
class Contender:
    """A policy and what planning said of it.

    `lower` and `upper` bound the model's optimum, None where the planner proves nothing about it;
    `planned` is what the policy is worth in the planner's own model, which may see more than there is to
    see, or suppose it of others.
    """

    name: str
    policy: BlockPolicy
    seconds: float
    lower: float | None = None
    upper: float | None = None
    planned: tuple[float, float] | None = None


@dataclass(frozen=True)
class FlatModel:
    """The flat quotient of a model, and how long it took to find."""

    reduction: Reduction
    seconds: float

    def solve(self, method: str, demand: Demand | None = None) -> POMDPSolution:
        """A solution from the initial belief."""
        return solve_pomdp(self.reduction.pomdp_quotient.pomdp, method, demand=demand)

    def policy(self, solution: POMDPSolution, tracker: BlockTracker) -> FlatPolicy:
        """The policy of a solution over the beliefs of a tracker."""
        numbers = {action.name: i for i, action in enumerate(tracker.symbolic.actions)}
        actions = [numbers[name] for name in self.reduction.pomdp_quotient.pomdp.actions]
        partition = self.reduction.partition
        return FlatPolicy(belief_policy(solution), partition, np.array(actions), tracker)


@dataclass(frozen=True)
class Contest:
    """The contenders on one tracker, in the order in which they are named above."""

    tracker: BlockTracker
    contenders: tuple[Contender, ...]


def flat_model(symbolic: SymbolicModel, options: Options) -> FlatModel:
    """The flat quotient.

    Raises:
        LimitReached: more blocks than a tracker may have, memory, or observations.
    """
    began = time.perf_counter()
    reduction = reduce(
        flat_process(symbolic),
        seed=options.seed,
        block_limit=BLOCK_LIMIT,
        maximum_observations=options.maximum_observations,
    )
    return FlatModel(reduction, time.perf_counter() - began)


def compiled(model: Model, tasks: TaskHierarchy | None, options: Options) -> SymbolicModel:
    """The model that several plans are to share.

    Raises:
        ModelError: it can't be planned with PolCA+.
    """
    refuse_unplannable(model)
    return compile_model(
        model, order=options.order, tasks=tasks or flat_task(model), memory_limit=options.memory_limit
    )


def flat_demand(trials: int, seed: int) -> Demand:
    """When the flat SARSOP stops: never by the clock."""
    return Demand(FLAT_GAP, iterations=trials, seed=seed)


def make_contest(
    model: Model,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    flat_trials: int | None = FLAT_TRIALS,
    progress: Progress = silent,
) -> Contest:
    """Plan a model in all four ways; `flat_trials` None leaves out SARSOP.

    Raises:
        ModelError: the model or the hierarchy is not right, or the state is seen.
        LimitReached: memory, blocks or observations.
    """
    options = replace(options or Options(), flat_block_limit=None)
    symbolic = compiled(model, tasks, options)
    progress("planning PolCA+")
    plan = plan_pomdp(model, tasks, options, symbolic=symbolic)
    polled: ExecutablePomdpPlan = executable_pomdp(plan)
    progress("planning PolCA")
    polca = plan_mdp(model, tasks, as_if_seen(options), symbolic=symbolic)
    progress("planning QMDP")
    flat = flat_model(symbolic, options)
    qmdp = flat.solve("qmdp")
    partitions = [*polled.partitions, flat.reduction.partition]
    known = [polca.root.policy, *(solved.cells for solved in polca.solved)]
    tracker = make_block_tracker(
        symbolic,
        partitions,
        conditions=[*polled.conditions, polca.root.policy],
        features=tested_features(symbolic, known),  # for the likeliest state
        block_limit=BLOCK_LIMIT,
        seed=options.seed,
    )
    bounds = (plan.root.lower, plan.root.upper)
    seen = (polca.polled.lower, polca.polled.upper)
    found = [
        Contender("PolCA+", PolledPolicy(polled, tracker), plan.seconds, planned=bounds),
        Contender("PolCA", MostLikelyPolicy(polca.root.policy, tracker), polca.seconds, planned=seen),
        _flat(flat, "QMDP", qmdp, tracker),
    ]
    if flat_trials is not None:
        progress(f"planning SARSOP, {flat_trials:,} trials")
        sarsop = flat.solve("sarsop", flat_demand(flat_trials, options.seed))
        if sarsop.status == "interrupted":
            raise KeyboardInterrupt
        found.append(_flat(flat, "SARSOP", sarsop, tracker))
    return Contest(tracker, tuple(found))


def _flat(flat: FlatModel, name: str, solution: POMDPSolution, tracker: BlockTracker) -> Contender:
    policy, seconds = flat.policy(solution, tracker), flat.seconds + solution.seconds
    return Contender(name, policy, seconds, solution.lower, solution.upper)
