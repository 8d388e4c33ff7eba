"""Polling over beliefs: what a task of a plan answers, for many beliefs at once.

The policy of task h is asked at the belief over its blocks.  If it answers a child that has surely ended
(the belief's whole support lies where the child has ended), h takes its best other action by looking one
step ahead with its own value function,

    Q(b, c) = R_c . b + gamma * sum over o of V(b K_c^o),

and where all others have ended as well, the child nonetheless, which then does its first action (DESIGN 5).
"""

from __future__ import annotations

import numpy as np

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan


def ask(
    plan: ExecutablePomdpPlan, name: str, beliefs: FloatArray, ended: BoolArray
) -> tuple[IntArray, BoolArray]:
    """The number of the action that task `name` chooses, and whether by looking ahead, both [n].

    Args:
        beliefs: [n, block] over the task's blocks.
        ended: [n, action] whether the belief is sure that the action, a child, has ended.
    """
    chosen = plan.policies[name].over_blocks.choose(beliefs)
    lost = ended[np.arange(len(chosen)), chosen] & ~ended.all(axis=1)
    for n in np.flatnonzero(lost).tolist():
        q_values = look_ahead(plan, name, beliefs[n])
        chosen[n] = int(np.where(ended[n], -np.inf, q_values).argmax())
    return chosen, lost


def look_ahead(plan: ExecutablePomdpPlan, name: str, belief: FloatArray) -> FloatArray:
    """Q [action] of task `name` at one belief [block], by one step and the task's value function."""
    pomdp, values = plan.quotient(name).pomdp, plan.values(name)
    result = pomdp.rewards @ belief
    for action, matrices in enumerate(pomdp.kernel):
        following = np.stack([belief @ matrix for matrix in matrices])
        result[action] += pomdp.discount * values.values(following).sum()
    return np.asarray(result, dtype=np.float64)
