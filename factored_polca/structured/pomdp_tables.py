"""What an action does to beliefs at one y: diagrams whose expectations are likelihoods and marginals.

See `factored_polca.structured.pomdp_belief` for what they are used for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import choose, support
from factored_polca.structured.alpha_forest import Forest
from factored_polca.structured.pomdp_model import Outcome, Step

if TYPE_CHECKING:
    from factored_polca.structured.pomdp_belief import BeliefSpace

IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class OutcomeTable:
    """Where an outcome's expectations stand among those of its step, and what is connected in it.

    `likelihood` is the number of L_o; the marginals at `entries` [e] are proportional to the expectations
    `roots` [e]; `groups` [feature] is where the entries of each feature begin.
    """

    outcome: Outcome
    likelihood: int
    entries: IntArray
    roots: IntArray
    groups: IntArray
    sizes: IntArray
    scopes: tuple[frozenset[int], ...]  # of factors; 2 k now, 2 k + 1 next, by place among the hidden
    product: dict[bytes, bool] = field(default_factory=dict)
    crowded: set[bytes] = field(default_factory=set)  # where the joint distribution was too large


class StepTable:
    """The expectations that an action at one y needs: first its reward, then those of its outcomes."""

    def __init__(self, space: BeliefSpace, step: Step) -> None:
        self.step = step
        self.forest = Forest(space.pomdp.manager)
        self.forest.add(step.reward)
        self.outcomes = [self._table(space, outcome) for outcome in step.outcomes]

    def _table(self, space: BeliefSpace, outcome: Outcome) -> OutcomeTable:
        pomdp, step = space.pomdp, self.step
        symbolic = pomdp.symbolic
        then = outcome.seen
        chance = pomdp.eliminate(step, then, outcome.weight)
        likelihood = self.forest.add(chance)
        reads = set(support(chance))
        told = set(support(outcome.weight))
        entries: list[int] = []
        roots: list[int] = []
        groups: list[int] = []
        sizes: list[int] = []
        for k in pomdp.hidden:
            count = len(pomdp.features[k].values)
            if k in step.changed:
                level = symbolic.next(k)
                weights = step.weights[then, k]
                parents = set().union(*(support(w) for w in weights))
                apart = level not in told and not parents & reads
                apart = apart and not any(p % 2 for p in parents)
                for v in range(count):
                    if apart:
                        part = weights[v]
                    else:
                        here = pomdp.manager.indicator(level, [v])
                        part = pomdp.eliminate(step, then, choose(here, outcome.weight, pomdp.zero))
                    roots.append(self.forest.add(part))
            elif symbolic.now(k) in reads:
                for v in range(count):
                    here = pomdp.manager.indicator(symbolic.now(k), [v])
                    roots.append(self.forest.add(choose(here, chance, pomdp.zero)))
            else:
                continue
            groups.append(len(entries))
            sizes.append(count)
            begin = int(space.offset[symbolic.now(k)])
            entries += range(begin, begin + count)
        scopes = [space.tokens(step, support(part)) for part in outcome.parts]
        for k in step.changed:
            levels = set().union(*(support(w) for w in step.weights[then, k]))
            scopes.append(space.tokens(step, [*levels, symbolic.next(k)]))
        return OutcomeTable(
            outcome, likelihood, np.array(entries, dtype=np.int64), np.array(roots, dtype=np.int64),
            np.array(groups, dtype=np.int64),
            np.array(sizes, dtype=np.int64), tuple(scopes),
        )  # fmt: skip
