"""Plans with approximate abstraction: near states merged, and what that costs at most.

Each task's process is that of its children's policies actually used, in the model itself; a process near
it is minimised in its place (`factored_polca.approximation`).  Bounds of a task are against that task's
optimum *given these policies*.  For the hierarchy as a whole there is a certified lower bound on what the
polled policy earns, and a certified upper bound on what any policy earns, hierarchical or not.

Where the exact quotients fit a limit of blocks, the loss is measured too, as a check: the policy's Markov
chain and the task itself are minimised exactly and solved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from factored_polca.approximation.approximate import (
    ApproximateReduction,
    Approximation,
    approximate,
    bounded_optimum,
    certify_mdp,
    certify_pomdp,
)
from factored_polca.approximation.bracket import bracketed
from factored_polca.approximation.snap import Snapped, as_epsilon, snap
from factored_polca.diagrams import FLOAT, Aborted, Diagram, MemoryLimit, choose, leaves
from factored_polca.hierarchy.evaluation import Evaluation
from factored_polca.hierarchy.options import Options
from factored_polca.minimisation import Choice, DecisionProcess, Reduction, flat_process, reduce
from factored_polca.minimisation.criterion import ProcessView, policy_primitives
from factored_polca.models import Fault, LimitReached, Model, ModelError
from factored_polca.solvers import Guarantee, MDPSolution, solve_mdp
from factored_polca.solvers.pomdp_result import POMDPSolution
from factored_polca.symbolic import NumericView, SymbolicModel


@dataclass(frozen=True)
class CertifiedBounds:
    """What is certain of a plan under the model's reward: of one whose tasks were merged approximately, or
    whose state is not seen.

    `polled_lower` <= what the polled policy earns <= `polled_upper`, what any policy earns <=
    `optimum_upper`; None where a bound was left out, and `note` says why.
    """

    polled_lower: float | None
    polled_upper: float | None
    optimum_upper: float | None
    note: str
    blocks: int = 0  # of the polled policy's chain

    def evaluation(self) -> Evaluation:
        """The bounds on the polled policy's value as an evaluation; its value is the lower one."""
        low, high = self.polled_lower, self.polled_upper
        assert low is not None
        assert high is not None
        guarantee = Guarantee("bounds", "the polled policy's value lies in [lower, upper]: " + self.note)
        return Evaluation(low, low, high, self.blocks, guarantee)

    @property
    def loss(self) -> float | None:
        """The most that the polled policy can earn less than the best policy."""
        if self.polled_lower is None or self.optimum_upper is None:
            return None
        return max(self.optimum_upper - self.polled_lower, 0.0)


@dataclass(frozen=True)
class Merging:
    """How a planner merges; `merging_for` makes it."""

    snapped: Snapped
    options: Options

    def reduce(
        self,
        process: DecisionProcess,
        block_limit: int | None,
        progress: Callable[[int, int], None] | None = None,
    ) -> ApproximateReduction:
        """A process of the model itself, merged.

        Raises:
            LimitReached: blocks, memory, time or observations.
        """
        options = self.options
        return approximate(
            process, self.snapped, seed=options.seed, block_limit=block_limit, deadline=options.deadline,
            progress=progress, maximum_observations=options.maximum_observations,
        )  # fmt: skip

    def has_purpose(self, process: DecisionProcess) -> bool:
        """Whether a process, not merged yet, has several rewards; see `subtask.refuse_without_purpose`."""
        view = ProcessView(process, NumericView(process.symbolic))
        found: set[float] = set()
        for choice in process.choices:
            app, rewards = view.app(choice), view.reward(choice)
            outside = rewards.manager.constant(np.inf, FLOAT)
            found |= {float(value) for value in leaves(choose(app, rewards, outside))}
        return len(found - {np.inf}) > 1

    def certify(
        self, reduction: Reduction, solution: MDPSolution, policy: Diagram, defined: Diagram
    ) -> Approximation:
        """What is certain of a task's policy, and what it loses in fact where that can be computed.

        `policy` and `defined` are the solution's policy carried to the states.

        Raises:
            LimitReached: memory or time.
        """
        assert isinstance(reduction, ApproximateReduction)
        with limits_named():
            found = certify_mdp(reduction, solution.policy, seed=self.options.seed)
        limit = self.options.flat_block_limit
        if limit is None:
            return found
        try:
            loss = measured_loss(reduction.original, policy, defined, limit, self.options)
        except LimitReached as error:
            return replace(found, measured_note=f"left out: {error}")
        return replace(found, measured_loss=loss, measured_note="the exact quotients, solved")

    def certify_pomdp(self, reduction: Reduction, solution: POMDPSolution) -> Approximation:
        """What is certain of a task's policy where the state is not seen: by the simulation lemma, and by
        solving and following the task itself where it has few enough blocks.

        Raises:
            LimitReached: memory or time.
        """
        assert isinstance(reduction, ApproximateReduction)
        options = self.options
        with limits_named():
            found = certify_pomdp(reduction, solution)
        found = replace(found, measured_note="the plan's episodes tell")
        if options.flat_block_limit is None:
            return found
        try:
            return bracketed(
                reduction, solution, found, block_limit=options.flat_block_limit,
                deadline=options.deadline, seed=options.seed,
            )  # fmt: skip
        except (LimitReached, MemoryLimit, Aborted) as error:
            return replace(found, note=f"{found.note}; no bracket: {error}")

    def bounds(self, chain: DecisionProcess, flat: DecisionProcess) -> CertifiedBounds:
        """Certified bounds on the value of `chain`, which has one choice, and on the optimum of `flat`."""
        notes, blocks = list[str](), 0
        lower = upper = optimum = None
        try:
            reduction = self.reduce(chain, self.options.block_limit)
            policy = np.where(reduction.mdp.applicable[0], 0, -1)
            with limits_named():
                found = certify_mdp(reduction, policy, seed=self.options.seed)
            lower, upper, blocks = found.lower, found.upper, reduction.partition.blocks
        except LimitReached as error:
            notes.append(f"no bounds on the policy: {error}")
        try:
            reduction = self.reduce(flat, self.options.block_limit)
            with limits_named():
                optimum = bounded_optimum(reduction, seed=self.options.seed)
        except LimitReached as error:
            notes.append(f"no bound on the optimum: {error}")
        note = "; ".join(notes) or "bounds over merged states"
        return CertifiedBounds(lower, upper, optimum, note, blocks)


@contextmanager
def limits_named() -> Iterator[None]:
    """Inside, limits of the diagrams are those of planning.

    Raises:
        LimitReached: in place of `MemoryLimit` and `Aborted`.
    """
    try:
        yield
    except (MemoryLimit, Aborted) as error:
        raise LimitReached(f"bounding the loss: {error}", "certificate") from None


def merging_for(symbolic: SymbolicModel, options: Options) -> Merging | None:
    """The merging that options ask for, None where they ask for exact abstraction.

    Raises:
        ModelError: no distance, discount 1, or interchangeable actions.
        LimitReached: memory or time.
    """
    if options.merge_within is None:
        return None
    refuse_unmergeable(symbolic.model, options)
    with limits_named():
        return Merging(snap(symbolic, as_epsilon(options.merge_within)), options)


def refuse_unmergeable(model: Model, options: Options) -> None:
    """Refuse what has no bound.

    Raises:
        ModelError: discount 1, or interchangeable actions.
    """
    if not model.discount < 1:
        hint = "give a discount below 1 (plan --discount D), or plan exactly"
        raise ModelError([Fault("at discount 1 merging near states has no bound", ("discount",), hint)])
    if options.interchangeable:
        raise ModelError("near states are merged with actions by name: leave --interchangeable out")


def measured_loss(
    process: DecisionProcess, policy: Diagram, defined: Diagram, block_limit: int, options: Options
) -> float:
    """The optimum of a fully observed process at b0, minus what a policy x -> primitive earns in it.

    Both are solved on exact quotients; infinite where the policy can run into a dead end that others avoid.

    Raises:
        LimitReached: more than `block_limit` blocks, memory or time.
    """
    best = _value(process, block_limit, options)
    chain = policy_chain(process, policy, defined)
    earned = _value(chain, block_limit, options)
    return 0.0 if best == earned else max(best - earned, 0.0)


def policy_chain(process: DecisionProcess, policy: Diagram, defined: Diagram) -> DecisionProcess:
    """The process whose only choice is what a policy x -> primitive takes where it is defined."""
    taken = policy_primitives(policy, defined, len(process.symbolic.actions))
    choice = Choice("policy", defined, taken, policy)
    return replace(process, choices=(choice,), rewards={p: process.rewards[p] for p in taken})


def _value(process: DecisionProcess, block_limit: int, options: Options) -> float:
    reduction = reduce(process, seed=options.seed, block_limit=block_limit)
    solution = solve_mdp(reduction.mdp, epsilon=options.epsilon, deadline=options.deadline)
    if solution.status == "interrupted":
        raise KeyboardInterrupt
    if solution.status == "time limit":
        raise LimitReached("the time limit was reached", "solve")
    belief = reduction.project_initial()
    here = belief > 0
    return float(belief[here] @ solution.values[here])


def seen_flat_process(
    symbolic: SymbolicModel, terminal: Diagram, reachable: Diagram | None
) -> DecisionProcess:
    """The process over all primitive actions with the state seen."""
    return replace(flat_process(symbolic, reachable=reachable, terminal=terminal), channels=None)


def approximation_report(found: Approximation | None) -> dict[str, Any]:
    """What is certain of a task's policy, as plain data; nothing for an exact abstraction."""
    if found is None:
        return {}
    return {
        "approximation": {
            "epsilon": float(found.epsilon),
            "lower": found.lower,
            "upper": found.upper,
            "optimum_upper": found.optimum,
            "loss_bound": found.loss,
            "model_error": found.model_error,
            "classes": found.classes,
            "collision_bound": found.collision_bound,
            "note": found.note,
            "measured_loss": found.measured_loss,
            "measured_note": found.measured_note,
        }
    }


def merging_report(root: Approximation | None, certified: CertifiedBounds | None) -> dict[str, Any]:
    """What is certain of a whole plan, as plain data, and how near its merged states are."""
    if certified is None:
        return {}
    merged = {} if root is None else {"merge_within": root.epsilon_text}
    return {
        **merged,
        "certified": {
            "polled_lower": certified.polled_lower,
            "polled_upper": certified.polled_upper,
            "optimum_upper": certified.optimum_upper,
            "loss_bound": certified.loss,
            "note": certified.note,
        },
    }


def merging_text(root: Approximation, certified: CertifiedBounds | None) -> str:
    """How far a plan with merged states may be trusted, in words."""
    text = (
        f"states within {root.epsilon_text} merged: given its children's policies the root loses at most "
        f"{root.loss:.3g} ({root.note})"
    )
    if certified is not None and certified.loss is not None:
        text += (
            f"; the polled policy earns at least {certified.polled_lower:.6g}, no policy more than "
            f"{certified.optimum_upper:.6g}"
        )
    elif certified is not None and certified.optimum_upper is not None:
        text += f"; no policy earns more than {certified.optimum_upper:.6g}"
    return (
        f"{text}; each class of states exact but for a chance below {max(root.collision_bound, 1e-300):.1g}"
    )
