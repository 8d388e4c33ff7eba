"""The sweeps of one policy on float diagrams: modified policy iteration (Puterman & Shin 1978).

Letters: pi a policy [x] -> primitive action, F where it is defined.

    (T_pi V)(x) = R_pi(x)(x) + gamma sum_x' P_pi(x)(x' | x) V(x')        in F, 0 elsewhere.

Either each primitive in use is regressed by itself and selected, or the policy is made one factored
action, P_pi(x)(x_i' | x) being the row of the primitive taken at x: one regression, of dearer rows.  Nobody
knows beforehand which is quicker, so both are tried and their steps counted.  One action of all can't be
made where a primitive in use has synchronic arcs.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.diagrams import Diagram, choose, leaves
from factored_polca.structured.bellman import Bellman, scale_leaves
from factored_polca.symbolic.regression import Prepared

TRIED: Final = 2
"""Sweeps of each kind before the steps of the last ones are compared."""


class PolicySweep:
    """The operator T_pi of a policy [x] -> primitive; the number of the model's actions where undefined."""

    def __init__(self, bellman: Bellman, policy: Diagram) -> None:
        self.bellman = bellman
        self.policy = policy
        manager, numbers = bellman.manager, bellman.numbers
        actions = bellman.process.symbolic.actions
        used = [int(leaf) for leaf in leaves(policy) if int(leaf) < len(actions)]
        self.where = {p: policy.equals(manager.constant(p)) for p in sorted(used)}
        self.reward = numbers.zero
        for p, where in self.where.items():
            self.reward = choose(where, bellman.rewards[p], self.reward)
        self.can_merge = not any(actions[p].synchronic for p in used)
        self.prepared: Prepared | None = None
        self.work: dict[bool, int] = {}
        self.sweeps = 0

    def _merged(self) -> Prepared:
        """The rows of the primitive taken at each state, as one action; undefined states stay put."""
        numbers, symbolic = self.bellman.numbers, self.bellman.process.symbolic
        manager = self.bellman.manager
        handles: list[Diagram] = []
        first = np.zeros(manager.leaf_level + 1, dtype=np.int64)
        last = -1
        for feature in range(len(symbolic.model.features)):
            changing = [p for p in self.where if feature in symbolic.actions[p].rows]
            parts = numbers.persisting(feature)
            for p in changing:
                rows = numbers.weights(p, feature)
                parts = [choose(self.where[p], row, part) for row, part in zip(rows, parts, strict=True)]
            first[symbolic.now(feature)] = len(handles)
            handles.extend(parts)
            if changing:
                last = max(last, symbolic.now(feature))
        key = manager.cache_key("policy regression", numbers.leaf_type, self.bellman.next_number())
        return Prepared(handles, first, last, key)

    def apply(self, value: Diagram, *, may_merge: bool) -> Diagram:
        """T_pi of a function that is 0 where the policy is undefined.

        With `may_merge` the policy is so settled that making one action of all may pay.
        """
        head = self.bellman.manager.head
        merge = may_merge and self.can_merge and self._merge_next()
        before = int(head[2])
        scaled = scale_leaves(value, self.bellman.discount)
        numbers = self.bellman.numbers
        if merge:
            if self.prepared is None:
                self.prepared = self._merged()
            ahead = numbers.regress_nodes(self.prepared, scaled)
        else:
            ahead = numbers.zero
            for p, where in self.where.items():
                ahead = choose(where, numbers.regress(p, scaled), ahead)
        result = self.bellman.masked(self.reward + ahead)
        self.work[merge] = int(head[2]) - before  # the last of each kind, caches being warm
        return result

    def _merge_next(self) -> bool:
        """Two sweeps of one kind, two of the other, then the quicker."""
        self.sweeps += 1
        if self.sweeps <= TRIED:
            return False
        if self.sweeps <= 2 * TRIED:
            return True
        return self.work[True] < self.work[False]
