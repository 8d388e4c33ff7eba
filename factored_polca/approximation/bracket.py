"""Tighter bounds where the state is not seen: by solving and following, in the process itself.

The simulation lemma (`lemma`) takes the worst for granted at each step.  Where the process itself has few
enough blocks, its quotient brackets the loss from both sides, as a check of the lemma and in its place:

    below   the policy of the snapped process is followed through the beliefs of the process itself
            (`factored_polca.solvers.policy_bounds`); at a belief b that is left it earns at least
            max of alpha . b - b . e,  with e by the lemma or by what its vectors promise too much in the
            process itself (`defects`);
    above   the process itself is searched for a while, and the upper bound taken.

Each is at least as good as the lemma's; the loss is at most their difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.approximation.approximate import ApproximateReduction, Approximation
from factored_polca.approximation.defects import overestimate
from factored_polca.approximation.lemma import block_errors, entry_span
from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation import make_pomdp_quotient, minimise
from factored_polca.minimisation.quotient import feature_states
from factored_polca.solvers.policy_bounds import bound_policy
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution

BELIEFS: Final = 1_000
"""Beliefs that are followed, unless another number is given."""

TRIALS: Final = 25
"""Trials of the search for an upper bound."""


def bracketed(
    reduction: ApproximateReduction,
    solution: POMDPSolution,
    found: Approximation,
    *,
    block_limit: int,
    beliefs: int = BELIEFS,
    trials: int = TRIALS,
    deadline: float | None = None,
    seed: int = 0,
) -> Approximation:
    """`found`, which the lemma says of a solution of the snapped process, or the bracket where better.

    Raises:
        LimitReached: the process itself has more than `block_limit` blocks or too many observations; time.
        MemoryLimit, Aborted: of the diagrams.
        KeyboardInterrupt: Ctrl-C.
    """
    policy, coarse = solution.policy, reduction.partition
    if isinstance(policy, PolicyGraph | StagedVectors):
        return found
    process = reduction.original
    partition = minimise(process, seed=seed, block_limit=block_limit, separate=[coarse.diagram]).partition
    pomdp = make_pomdp_quotient(process, partition, seed=seed).pomdp
    block = reduction.project_states(feature_states(partition))
    onto = csr_array(
        (np.ones(len(block)), (np.arange(len(block)), block)), shape=(len(block), coarse.blocks)
    )

    def choose(beliefs: FloatArray) -> IntArray:
        return policy.choose(np.asarray(beliefs @ onto))

    floor = None
    if isinstance(policy, AlphaVectors):
        floor = lower_values(reduction, solution, policy, pomdp, onto)
    followed = bound_policy(pomdp, choose, beliefs=beliefs, deadline=deadline, floor=floor)
    searched = solve_pomdp(
        pomdp, "sarsop", demand=Demand(gap=1e-9, iterations=trials, deadline=deadline, seed=seed)
    )
    if searched.status == "interrupted":
        raise KeyboardInterrupt
    lower, optimum = max(found.lower, followed.lower), min(found.optimum, searched.upper)
    note = (
        f"{found.note}, or {followed.followed:,} beliefs followed and {searched.iterations:,} trials of a "
        f"search on the {partition.blocks:,} blocks of the task itself, whichever is better"
    )
    return replace(
        found, lower=lower, upper=min(found.upper, followed.upper, optimum), optimum=optimum,
        loss=max(min(found.loss, optimum - lower), 0.0), note=note,
    )  # fmt: skip


def lower_values(
    reduction: ApproximateReduction,
    solution: POMDPSolution,
    policy: AlphaVectors,
    pomdp: ArrayPOMDP,
    onto: csr_array,
) -> Callable[[FloatArray], FloatArray] | None:
    """What the policy of a solution earns at least in `pomdp` [n] at its beliefs [n, s]; None: not known.

    `onto` [s, block] is 1 where a state lies in a block.
    """
    block = np.asarray(onto.indices, dtype=np.int64)
    of_blocks = errors_below(reduction, solution)
    errors = [] if of_blocks is None else [np.asarray(onto @ of_blocks)]
    more = overestimate(pomdp, policy, block, reduction.original.symbolic.manager.pause)
    errors += [] if more is None else [*more]
    if not errors:
        return None
    less = np.stack(errors)

    def values(beliefs: FloatArray) -> FloatArray:
        found: FloatArray = policy.values(np.asarray(beliefs @ onto)) - (beliefs @ less.T).min(axis=1)
        return found

    return values


def errors_below(reduction: ApproximateReduction, solution: POMDPSolution) -> FloatArray | None:
    """By how much less than its value function the policy may earn [block]; None: not known.

    What the solver's bound at b0 is less than its vectors say there is rounding, and taken off too.
    """
    span = entry_span(solution.policy)
    if span is None:
        return None
    assert isinstance(solution.policy, AlphaVectors)
    quotient = reduction.pomdp_quotient
    rounding = max(solution.policy.value(quotient.pomdp.initial) - solution.lower, 0.0)
    return block_errors(reduction.errors(), quotient.mdp, span) + rounding
