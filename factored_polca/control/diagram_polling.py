"""Polling a task that was solved on diagrams: its alpha-vectors are asked at the whole belief.

A belief as diagrams is asked exactly; of any other that has marginals, their product.  What `polling`
says of a child that has surely ended holds here too, with

    Q(b, c) = R_c . b + gamma * sum over o of P(o | b, c) V(b_o),

where what follows b is formed as when planning (`structured.pomdp_belief`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.control.block_tracker import BlockBelief
from factored_polca.control.diagram_tracker import DiagramBelief
from factored_polca.control.tracker import Belief
from factored_polca.explicit.arrays import BoolArray, FloatArray
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.models import ModelError


def point_of(policy: Any, belief: Belief) -> Any:
    """A belief as a policy of alpha-vectors on diagrams is asked at it.

    Raises:
        ModelError: a belief over blocks, which tells too little.
        LimitReached: it has too many nodes as one diagram.
    """
    if isinstance(belief, DiagramBelief):
        return policy.space.of_factors(belief.factors)
    if isinstance(belief, BlockBelief):
        raise ModelError(
            "a policy on diagrams is asked at beliefs as diagrams, or particles, not over blocks"
        )
    return policy.space.of_marginals(belief.marginals())


def ask_on_diagrams(
    plan: ExecutablePomdpPlan, name: str, belief: Belief, ended: BoolArray
) -> tuple[int, bool]:
    """The number of the action that task `name` chooses at a belief, and whether by looking ahead.

    `ended` [action] says whether the belief is sure that the action, a child, has ended.
    """
    policy: Any = plan.policies[name].policy
    point = point_of(policy, belief)
    chosen = int(policy.choose(point))
    if not ended[chosen] or ended.all():
        return chosen, False
    values = look_ahead_on_diagrams(plan, name, point)
    return int(np.where(ended, -np.inf, values).argmax()), True


def look_ahead_on_diagrams(plan: ExecutablePomdpPlan, name: str, point: Any) -> FloatArray:
    """Q [action] of task `name` at a belief, by one step and the task's alpha-vectors."""
    policy: Any = plan.policies[name].policy
    space, discount = plan.follow(name), float(plan.model.discount)
    result = np.zeros(len(plan.policies[name].actions))
    for action in range(len(result)):
        reward, follows = space.follow(point, action)
        after = sum(f.probability * policy.value(f.belief) for f in follows if f is not None)
        result[action] = reward + discount * after
    return result
