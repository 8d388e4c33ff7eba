"""Tables as decision trees: T and O over a state, R over a state, the next state and an observation.

Equal parts are one object, so that equality is identity here.  A decision over x lists the values
whose case differs from the most frequent one, which is its `otherwise`; a decision with one case only
is that case.  Rewards are decided in one order throughout, so that they mention exactly the references
they depend on (R. E. Bryant 1986: reduced ordered decision graphs are canonical).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from factored_polca.formats.cassandra_layers import MAXIMUM_STEPS, Layer, StepLimit, Steps, folded, slices
from factored_polca.formats.cassandra_names import Index
from factored_polca.models.expressions import ZERO, Expression, Reference, Switch

FIRST_TRY: Final = 500_000
SECOND_TRY: Final = 4_000_000
"""Steps after which the rewards of an action are tried in the other order."""

Path = Sequence[tuple[Reference, Index]]


@dataclass
class Decisions:
    """Decisions over values, each made once."""

    steps: Steps
    known: dict[Expression, Expression] = field(default_factory=dict)

    def decision(
        self, reference: Reference, index: Index, chosen: Mapping[int, Expression], other: Expression
    ) -> Expression:
        """`chosen[v]` where `reference` has value number v, and `other` where v is not among them.

        Raises:
            StepLimit: too much work.
        """
        self.steps.count(len(chosen) + 1)
        counts: dict[int, int] = {}  # by identity
        parts: dict[int, Expression] = {}
        for part in chosen.values():
            parts[id(part)] = part
            counts[id(part)] = counts.get(id(part), 0) + 1
        if len(index) > len(chosen):
            parts[id(other)] = other
            counts[id(other)] = counts.get(id(other), 0) + len(index) - len(chosen)
        if len(parts) == 1:
            return next(iter(parts.values()))
        largest = max(counts.values())
        if counts.get(id(other)) == largest and list(counts.values()).count(largest) == 1:
            usual, listed = other, sorted(chosen)
        else:  # then `chosen` is at least half of all values; among equals, the first value's counts
            self.steps.count(len(index))
            listed = list(range(len(index)))
            usual = next(p for v in listed if counts[id(p := chosen.get(v, other))] == largest)
        cases = [(index.values[v], chosen.get(v, other)) for v in listed]
        switch = Switch(reference, tuple(case for case in cases if case[1] is not usual), usual)
        return self.known.setdefault(switch, switch)

    def persistent(
        self, reference: Reference, index: Index, chosen: Mapping[int, Expression], other: Expression
    ) -> Expression:
        """`decision`, where values that stay as they are may share the case `reference` itself."""
        staying = [v for v, part in chosen.items() if part is index.constants[v]]
        frequent: dict[int, int] = {}
        for part in chosen.values():
            frequent[id(part)] = frequent.get(id(part), 0) + 1
        frequent[id(other)] = frequent.get(id(other), 0) + len(index) - len(chosen)
        if len(staying) > max(frequent.values()) or len(staying) == len(index):
            chosen = {**chosen, **dict.fromkeys(staying, reference)}
        return self.decision(reference, index, chosen, other)

    def rewards(self, layers: Sequence[Layer], path: Path) -> Expression:
        """The tree over the references of `path` of what `layers` of one action give.

        A layer's first index is the action's, then there is one for each reference.  These are
        decided in the order of `path`, or with the first two exchanged where that is less work.

        Raises:
            StepLimit: too much work.
        """
        tries = [(MAXIMUM_STEPS, False)]
        if len(path) == 3:
            tries = [(FIRST_TRY, False), (FIRST_TRY, True), (SECOND_TRY, False), (MAXIMUM_STEPS, True)]
        for most, exchanged in tries[:-1]:
            try:
                with self.steps.at_most(most):
                    return self._ordered(layers, path, exchanged)
            except StepLimit:
                continue
        return self._ordered(layers, path, tries[-1][1])

    def _ordered(self, layers: Sequence[Layer], path: Path, exchanged: bool) -> Expression:
        if not exchanged:
            return self._tree(layers, path, 0)
        self.steps.count(len(layers))
        layers = [
            layer._replace(indices=(layer.indices[0], layer.indices[2], layer.indices[1]))
            for layer in layers
        ]
        return self._tree(layers, (path[1], path[0], path[2]), 0)

    def _tree(self, layers: Sequence[Layer], path: Path, depth: int) -> Expression:
        reference, index = path[depth]
        if depth == len(path) - 1:
            row = folded(layers, self.steps)
            return self.decision(reference, index, row.cells, row.default)
        found = slices(layers, depth + 1, self.steps)
        chosen = {value: self._tree(part, path, depth + 1) for value, part in found.named()}
        other: Expression = ZERO
        if len(chosen) < len(index):
            other = self._tree(found.others(), path, depth + 1)
        return self.decision(reference, index, chosen, other)
