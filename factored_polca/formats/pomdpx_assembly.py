"""The initial belief and the actions of a POMDPX model, from one decision tree for each variable.

The tree of x_1 decides the action variables first; action a takes its cofactor P_a(x' | parents).
A tree that says x' = x is left out: x persists.  Under each action the arcs among next values are
acyclic, and so are those among the variables of the initial belief.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import networkx as nx

from factored_polca.formats.pomdpx_document import Faults, Place, quoted
from factored_polca.formats.pomdpx_variables import Variable, Variables
from factored_polca.formats.spudd_trees import Forest
from factored_polca.models.expressions import Constant, Expression, Reference
from factored_polca.models.model import Action, InitialBelief

Trees = Mapping[Variable, Expression]
Named = list[tuple[str, Expression]]


@dataclass
class Assembly:
    """Puts trees together; circles are added to the faults."""

    forest: Forest
    variables: Variables
    faults: Faults
    acting: int = field(init=False)  # the bits of the action variables

    def __post_init__(self) -> None:
        self.acting = sum(self.forest.bit(action.reference) for action in self.variables.actions)

    def initial(self, trees: Trees, place: Place) -> InitialBelief:
        """The belief with one distribution for each tree, in the order of the features."""
        states = [state for state in self.variables.states if state.now in trees]
        found = [(state.feature, trees[state.now]) for state in states]
        self._circle(found, self._bits(primed=False), "<InitialStateBelief>", place)
        return InitialBelief(found)

    def actions(
        self, effects: Trees, senses: Trees, rewards: Sequence[Expression], place: Place
    ) -> tuple[list[Action], list[Expression]]:
        """The actions, and the rewards that are the same for all of them."""
        forest = self.forest
        states = [(state.feature, effects[state.next]) for state in self.variables.states]
        changing = [(x, tree) for x, tree in states if tree != Reference(x)]
        sensing = [(channel.name, senses[channel]) for channel in self.variables.observations]
        special = [("", tree) for tree in rewards if forest.support(tree) & self.acting]
        common = [("", tree) for tree in rewards if not forest.support(tree) & self.acting]
        bits = self._bits(primed=True)
        linked = any(forest.support(tree) & bits for _, tree in changing)
        found = []
        for name, choice in self.variables.joint_actions():
            forest.count(1 + len(changing) + len(sensing) + len(special))
            changed = [(x, tree) for x, tree in self._cofactors(changing, choice) if tree != Reference(x)]
            if linked:
                linked = not self._circle(changed, bits, f"action {quoted(name)}", place)
            own = _terms(self._cofactors(special, choice))
            found.append(Action(name, changed, rewards=own, senses=self._cofactors(sensing, choice)))
        return found, _terms(common)

    def _cofactors(self, trees: Named, choice: Mapping[str, str]) -> Named:
        """`trees` where the action variables have the values `choice`."""
        found = []
        for name, tree in trees:
            for variable, value in choice.items():
                if not self.forest.support(tree) & self.acting:
                    break
                tree = self.forest.restrict(tree, Reference(variable), value)
            found.append((name, tree))
        return found

    def _bits(self, *, primed: bool) -> int:
        bits = 0
        for state in self.variables.states:
            bits |= self.forest.bit(Reference(state.feature, primed))
        return bits

    def _circle(self, trees: Named, bits: int, where: str, place: Place) -> bool:
        """Whether variables, those of `bits`, depend on each other in a circle, which is a fault."""
        graph = nx.DiGraph()
        for name, tree in trees:
            for parent in self.forest.mentioned(self.forest.support(tree) & bits):
                graph.add_edge(parent, Reference(name, parent.primed))
        if nx.is_directed_acyclic_graph(graph):
            return False
        names = {v.reference: v.name for state in self.variables.states for v in (state.now, state.next)}
        cycle = [names[edge[0]] for edge in nx.find_cycle(graph)]
        circle = " -> ".join([*cycle, cycle[0]])
        self.faults.add(f"in {where} variables depend on each other in a circle: {circle}", place,
                        "they may depend on each other only acyclically")  # fmt: skip
        return True


def _terms(trees: Named) -> list[Expression]:
    return [tree for _, tree in trees if not (isinstance(tree, Constant) and tree.value == 0)]
