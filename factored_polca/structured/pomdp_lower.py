"""Lower bounds: alpha-vectors as diagrams over the hidden features, a set for each y.

The backup of the alpha-vectors chosen for each outcome of an action,

    alpha(x) = R(x) + discount * sum over o, x' of P(x' | x) W_o(x, x') alpha_o(x'),

is what a plan earns that begins with the action and goes on with the plan of alpha_o: a lower bound at
every state, whatever the beliefs at which the alpha_o were chosen (Pineau, Gordon & Thrun 2003; on diagrams
Hansen & Feng 2000, Poupart 2005).  What rounding may have added is taken off again, and leaves are merged
downwards.  So each alpha-vector is at most the backup of its `children`, and a set that has the children of
each of its members has a greedy policy that earns at least the set's maximum at any belief.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Final

import numpy as np

from factored_polca.diagrams import FLOAT, Diagram, choose, node_count
from factored_polca.structured.alpha_forest import Forest
from factored_polca.structured.pomdp_belief import BeliefSpace
from factored_polca.structured.pomdp_cells import (
    CELLS,
    Table,
    TooManyCells,
    eliminate,
    merged_diagram,
    step_tables,
    table_of,
)
from factored_polca.structured.pomdp_model import FactoredPOMDP, Seen, Step
from factored_polca.structured.pomdp_point import FloatArray, PointBelief
from factored_polca.structured.rounding import round_leaves, round_to_size

FEWEST_CELLS: Final = 1_024
CROWDED: Final = 20
"""Tables take the place of diagrams with a node for fewer than so many cells; of at least so many cells."""


@dataclass(frozen=True, eq=False)
class Alpha:
    """An alpha-vector at the y `seen`: what a plan earns that begins with `action`.

    `children` are those that it goes on with; a blind policy goes on with itself and has
    none.
    """

    seen: Seen
    action: int
    diagram: Diagram
    children: tuple[Alpha, ...] = ()
    blind: bool = False


class AlphaSet:
    """The alpha-vectors at one y.  `version` changes where their numbers do."""

    def __init__(self, pomdp: FactoredPOMDP, alphas: Iterable[Alpha]) -> None:
        self.pomdp = pomdp
        self.alphas: list[Alpha] = []
        self.forest = Forest(pomdp.manager)
        self.version = 0
        self.kept = 0
        for alpha in alphas:
            self.add(alpha)
        self.kept = len(self.alphas)

    def add(self, alpha: Alpha) -> int:
        """One more; its number."""
        self.forest.add(alpha.diagram)
        self.alphas.append(alpha)
        return len(self.alphas) - 1

    def keep(self, numbers: Sequence[int]) -> None:
        """Leave only some, numbered anew in the order given."""
        alphas = [self.alphas[n] for n in numbers]
        forest = Forest(self.pomdp.manager)
        for alpha in alphas:
            forest.add(alpha.diagram)
        self.alphas, self.forest = alphas, forest
        self.version += 1
        self.kept = len(alphas)


class LowerBound:
    """All alpha-vectors, and the backup."""

    def __init__(
        self,
        space: BeliefSpace,
        blind: Sequence[tuple[int, Diagram]],
        size: float,
        *,
        nodes: int,
        width: float,
    ) -> None:
        self.space, self.pomdp = space, space.pomdp
        self.blind, self.size = tuple(blind), size
        self.nodes, self.width = nodes, width
        self.sets: dict[Seen, AlphaSet] = {}
        self.loss = 0.0  # the most that merging has taken off in a backup
        self._dead: dict[Seen, Diagram] = {}
        levels = [space.pomdp.symbolic.now(k) for k in space.pomdp.hidden]
        self.axes = tuple(sorted(levels))
        self.cells = prod(space.pomdp.manager.sizes[level] for level in levels)
        self._tables: dict[tuple[Seen, int], tuple[list[Table], dict[Seen, dict[int, Table]]]] = {}
        self._no_cells = False

    def at(self, seen: Seen) -> AlphaSet:
        """The alpha-vectors at one y; at first those of the blind policies."""
        if seen not in self.sets:
            found = [Alpha(seen, a, self.pomdp.at(seen, d), blind=True) for a, d in self.blind]
            distinct: list[Alpha] = []
            for alpha in found:
                if all(alpha.diagram != other.diagram for other in distinct):
                    distinct.append(alpha)
            self.sets[seen] = AlphaSet(self.pomdp, distinct)
        return self.sets[seen]

    @property
    def count(self) -> int:
        """How many alpha-vectors there are."""
        return sum(len(s.alphas) for s in self.sets.values())

    def values(self, belief: PointBelief, since: int = 0) -> FloatArray:
        """The expectation of each alpha-vector from number `since` on."""
        return self.space.expectations(belief, self.at(belief.seen).forest, since)

    def dead(self, seen: Seen) -> Diagram:
        """Where the state is terminal."""
        if seen not in self._dead:
            self._dead[seen] = self.pomdp.at(seen, self.pomdp.symbolic.terminal)
        return self._dead[seen]

    def backup(self, step: Step, chosen: Sequence[Alpha]) -> Alpha:
        """The alpha-vector of an action and of one alpha-vector for each of its outcomes."""
        error = self.pomdp.backup_error(step, self.size)
        distinct = {id(alpha): alpha for alpha in chosen}
        found = self.by_cells(step, chosen, error) if self._crowded(distinct.values()) else None
        if found is None:
            found = self.by_diagrams(step, chosen, error)
        diagram, loss = found
        self.loss = max(self.loss, loss)
        return Alpha(step.seen, step.action, diagram, tuple(distinct.values()))

    def by_diagrams(self, step: Step, chosen: Sequence[Alpha], error: float) -> tuple[Diagram, float]:
        """The backup less `error`, leaves merged, on diagrams; and what merging has taken off."""
        pomdp = self.pomdp
        after = pomdp.regress(step, [alpha.diagram for alpha in chosen])
        total = step.reward + after * pomdp.manager.constant(pomdp.discount, FLOAT)
        total = choose(self.dead(step.seen), pomdp.zero, pomdp.shifted_by(total, -error))
        rounded = round_leaves(total, self.width, "down")
        if node_count(rounded.diagram) > self.nodes:
            rounded = round_to_size(total, nodes=self.nodes, width=self.width, direction="down")
        return rounded.diagram, rounded.error

    # -- on tables -------------------------------------------------------------------------------

    def _crowded(self, alphas: Iterable[Alpha]) -> bool:
        """Whether diagrams have so many nodes that tables are better."""
        if not FEWEST_CELLS <= self.cells <= CELLS or self._no_cells:
            return False
        return any(node_count(alpha.diagram) * CROWDED > self.cells for alpha in alphas)

    def by_cells(self, step: Step, chosen: Sequence[Alpha], error: float) -> tuple[Diagram, float] | None:
        """The same on tables; None where one on the way is too large."""
        pomdp, symbolic = self.pomdp, self.pomdp.symbolic
        key = (step.seen, step.action)
        moved = {symbolic.now(k): symbolic.next(k) for k in step.changed}
        try:
            if key not in self._tables:
                self._tables[key] = step_tables(pomdp, step)
            outcomes, weights = self._tables[key]
            sums: dict[Seen, Table] = {}
            for outcome, weight, alpha in zip(step.outcomes, outcomes, chosen, strict=True):
                part = weight * table_of(alpha.diagram, self.axes).moved(moved)
                before = sums.get(outcome.seen)
                sums[outcome.seen] = part if before is None else before + part
            total = table_of(step.reward, self.axes)
            synchronic = symbolic.actions[step.action].synchronic
            for then, function in sums.items():
                after = eliminate(function, weights[then], synchronic)
                total = total + Table(after.axes, pomdp.discount * after.values)
        except TooManyCells:
            self._no_cells = True
            return None
        shape = [pomdp.manager.sizes[axis] for axis in self.axes]
        live = table_of(pomdp.at(step.seen, pomdp.live), self.axes).values > 0
        values = np.where(live, np.broadcast_to(total.over(self.axes), shape) - error, 0.0)
        return merged_diagram(pomdp.manager, Table(self.axes, values), self.width, self.nodes, "down")


def closure(alphas: Iterable[Alpha]) -> list[Alpha]:
    """The alpha-vectors and those that they go on with, each once."""
    found: dict[int, Alpha] = {}
    waiting = list(alphas)
    while waiting:
        alpha = waiting.pop()
        if id(alpha) not in found:
            found[id(alpha)] = alpha
            waiting += alpha.children
    return list(found.values())
