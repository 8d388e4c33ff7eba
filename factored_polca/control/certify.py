"""Certified bounds on what a plan of PolCA+ earns, beside what its episodes measured.

The polled policy is deterministic, so the beliefs that it meets from the start form a graph, which is
followed as far as a number of beliefs allows (`factored_polca.solvers.policy_bounds`).  It is followed over
the blocks of the coarsest partition that is stable for the model, rewards included, and tells apart what
the tasks do: there beliefs and rewards are those of the model itself, also where near states were merged.

A plan of one task is the task's solver's own policy: then its bounds at b0 hold too.  No policy earns more
than the flat bound.
"""

from __future__ import annotations

import math

from factored_polca.control.belief_policies import PolledPolicy
from factored_polca.control.block_tracker import BlockTracker, kept_apart
from factored_polca.control.tracker import BLOCK_LIMIT, BYTES_PER_BLOCK, limited_memory
from factored_polca.diagrams import Aborted, MemoryLimit
from factored_polca.hierarchy.followed import BELIEFS, PolicyBounds, bound_on_blocks
from factored_polca.hierarchy.merging import CertifiedBounds
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.hierarchy.pomdp_plan import PomdpPlan
from factored_polca.minimisation import flat_process, minimise
from factored_polca.models import LimitReached


def certify_plan(
    found: PomdpPlan,
    plan: ExecutablePomdpPlan | None = None,
    *,
    beliefs: int = BELIEFS,
    block_limit: int = BLOCK_LIMIT,
    deadline: float | None = None,
    seed: int = 0,
) -> CertifiedBounds:
    """Bounds on what a plan earns when it is polled, and on what any policy earns.

    Args:
        plan: what is executed, where it has been made already.
        beliefs: how many beliefs are followed at most.
        block_limit: blocks beyond which there are no bounds on the polled policy; the note says so.
        deadline: a reading of `time.monotonic()` at which following them ends.
        seed: of random elements.
    """
    optimum, blocks, root = upper_bound(found), 0, found.root
    most = math.inf if optimum is None else optimum
    plan = executable_pomdp(found) if plan is None else plan
    try:
        followed, blocks = polled_bounds(
            plan, beliefs=beliefs, block_limit=block_limit, deadline=deadline, seed=seed
        )
    except (LimitReached, MemoryLimit, Aborted) as error:
        note = f"beliefs were not followed: {error}"
        if own_policy(found):
            return CertifiedBounds(root.lower, min(root.upper, most), optimum, note)
        return CertifiedBounds(None, None, optimum, note)
    low, high = followed.lower, min(followed.upper, most)
    if own_policy(found):
        low, high = max(low, root.lower), min(high, root.upper)
    rest = f"{followed.left:,} left, worth what any policy may earn" if followed.left else "and none left"
    note = f"{followed.followed:,} beliefs over {blocks:,} blocks followed, {rest}"
    return CertifiedBounds(low, high, optimum, note, blocks)


def polled_bounds(
    plan: ExecutablePomdpPlan,
    *,
    beliefs: int = BELIEFS,
    block_limit: int = BLOCK_LIMIT,
    deadline: float | None = None,
    seed: int = 0,
) -> tuple[PolicyBounds, int]:
    """Bounds on what polling a plan earns, and over how many blocks they were found.

    Raises:
        LimitReached, MemoryLimit, Aborted: too many blocks or observations, memory or time; or a task was
            solved on diagrams, and has no policy over blocks.
        ModelError: discount 1.
    """
    names = [task.name for task in plan.policies.values() if task.on_diagrams]
    if names:
        raise LimitReached(f"solved on diagrams, with no policy over blocks: {', '.join(names)}", "certify")
    symbolic = plan.symbolic
    process = flat_process(symbolic)
    separate = kept_apart(symbolic, plan.partitions, plan.conditions)
    with limited_memory(symbolic.manager, BYTES_PER_BLOCK * block_limit, deadline):
        partition = minimise(process, seed=seed, block_limit=block_limit, separate=separate).partition
        policy = PolledPolicy(plan, BlockTracker(partition))
        found = bound_on_blocks(
            process, partition, policy.choose, beliefs=beliefs, deadline=deadline, seed=seed
        )
    return found, partition.blocks


def own_policy(found: PomdpPlan) -> bool:
    """Whether polling is following the policy of the root's solver in the model itself."""
    root = found.root
    return (
        len(found.solved) == 1
        and not root.task.has_pseudo_reward
        and root.task.observes is None
        and root.approximation is None
        and ends_with_the_model(found)
    )


def ends_with_the_model(found: PomdpPlan) -> bool:
    """Whether the root ends where the model does, and nowhere else."""
    return found.root.process.terminal == found.symbolic.terminal


def upper_bound(found: PomdpPlan) -> float | None:
    """What no policy can exceed, where it is known of the model itself."""
    merged = None if found.certified is None else found.certified.optimum_upper
    known = [bound for bound in (merged, found.flat.upper) if bound is not None]
    return min(known) if known and ends_with_the_model(found) else None
