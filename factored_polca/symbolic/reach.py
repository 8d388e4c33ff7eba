"""The reachable states: the closure of the initial belief's support under actions.

Letters: S a set of states x, A_a(x) = app_a where action a is applicable and x not terminal,
C_i(x_i', x, x') = [P_a(x_i' | parents) > 0] for each feature i that a changes.

    image_a(S)(x') = exists x_i, i changed:  S(x) and A_a(x) and the conjunction of all C_i

Features that a does not change stay as they are and need neither a conjunct nor a copy.  The C_i are
never multiplied out: they are taken in the order of the variables, neighbours joined into *clusters*
while those stay small, and x_i is quantified after the last cluster that reads it (Burch, Clarke &
Long 1991, "Symbolic model checking with partitioned transition relations"; Ranjan et al. 1995).
Breadth-first from S_0 = {x: b0(x) > 0}, only new states being expanded, to the fixpoint.

Two backends do the same: "dd" with binary decision diagrams of the package dd, "kernel" with the set
operations of `factored_polca.diagrams`.  Each is the other's check.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final, Literal, Protocol, TypeAlias

from factored_polca.diagrams import (
    Diagram,
    apply,
    choose,
    cofactors,
    leaves,
    move,
    node_count,
    states_of_leaves,
    sum_out,
    support,
)
from factored_polca.symbolic.boolean_sets import BooleanSets
from factored_polca.symbolic.model import SymbolicAction, SymbolicModel
from factored_polca.symbolic.rows import RowDiagram, possible

Backend: TypeAlias = Literal["dd", "kernel"]

CLUSTER_NODES: Final = 300
"""A cluster takes one conjunct more while it has at most so many nodes."""


@dataclass(frozen=True)
class Reachable:
    """The states that can be reached.

    `diagram` has the leaf 1 at reachable states and 0 elsewhere, over the present variables;
    `states` is their exact number; `iterations` counts breadth-first steps, the last of which found
    nothing new.
    """

    diagram: Diagram
    states: int
    iterations: int
    backend: str


@dataclass(frozen=True)
class Cluster:
    """Conjuncts of one action joined: a condition over (x, x').

    `drawn` are the next levels that it chooses values for; `quantified` the present levels that no
    later cluster reads.
    """

    relation: Diagram
    drawn: tuple[int, ...]
    quantified: tuple[int, ...]


@dataclass(frozen=True)
class TransitionRelation:
    """The partitioned relation of one action; `renaming` maps the next levels to present ones."""

    app: Diagram
    clusters: tuple[Cluster, ...]
    renaming: dict[int, int]


def reachable_states(
    symbolic: SymbolicModel, actions: Sequence[str] | None = None, backend: Backend = "dd"
) -> Reachable:
    """The closure of b0's support under `actions` (None: all primitive actions of the model).

    Raises:
        KeyError: an unknown action; the message lists those there are.
        ValueError: an unknown backend.
        Aborted, MemoryLimit: as the manager says.
    """
    if backend not in ("dd", "kernel"):
        raise ValueError(f"no backend {backend!r}; there are dd, kernel")
    names = [action.name for action in symbolic.actions]
    for name in actions or ():
        if name not in names:
            raise KeyError(f"no action {name!r}; there are {', '.join(names)}")
    wanted = [a for a in symbolic.actions if actions is None or a.name in actions]
    relations = [transition_relation(symbolic, action) for action in wanted]
    start = initial_support(symbolic)
    if backend == "kernel":
        reached, iterations = _closure(symbolic, _KernelSets(relations), start)
    else:
        sets = BooleanSets(symbolic)
        with sets.running():
            reached, iterations = _closure(symbolic, _LibrarySets(sets, symbolic, relations), start)
    counts = dict(zip(leaves(reached), states_of_leaves(reached, symbolic.now_levels), strict=True))
    return Reachable(reached, counts.get(1, 0), iterations, backend)


def initial_support(symbolic: SymbolicModel) -> Diagram:
    """The set of states to which the initial belief gives a positive probability."""
    result = symbolic.manager.constant(1)
    for feature in sorted(symbolic.initial, key=symbolic.now, reverse=True):
        result = result & possible(symbolic.initial[feature], symbolic.next(feature))
    count = len(symbolic.order)
    return move(result, {2 * place + 1: 2 * place for place in range(count)})


def transition_relation(symbolic: SymbolicModel, action: SymbolicAction) -> TransitionRelation:
    """The conjuncts of an action, clustered, with the place where each variable is quantified."""
    changed = sorted(action.rows, key=symbolic.now)
    joined: list[tuple[Diagram, tuple[int, ...]]] = []
    for feature in changed:
        row = action.rows[feature]
        conjunct = possible(row, symbolic.next(feature))
        for parent in row.parents_next:
            if parent not in action.rows:
                conjunct = _persisting(symbolic, conjunct, parent)
        level = symbolic.next(feature)
        if joined:
            relation, drawn = joined[-1]
            both = relation & conjunct
            if node_count(both) <= CLUSTER_NODES:
                joined[-1] = (both, (*drawn, level))
                continue
        joined.append((conjunct, (level,)))
    last_read = {symbolic.now(feature): 0 for feature in changed}
    for place, (relation, _) in enumerate(joined):
        for level in support(relation):
            if level in last_read:
                last_read[level] = place
    clusters = tuple(
        Cluster(relation, drawn, tuple(level for level, last in last_read.items() if last == place))
        for place, (relation, drawn) in enumerate(joined)
    )
    renaming = {symbolic.next(feature): symbolic.now(feature) for feature in changed}
    return TransitionRelation(action.app, clusters, renaming)


def _persisting(symbolic: SymbolicModel, condition: Diagram, feature: int) -> Diagram:
    """`condition` with the next value of a feature that persists replaced by its present one."""
    parts = cofactors(condition, symbolic.next(feature))
    result = parts[-1]
    for value, part in enumerate(parts[:-1]):
        result = choose(symbolic.manager.indicator(symbolic.now(feature), [value]), part, result)
    return result


class _Sets(Protocol):
    """What the closure needs of a backend; a set is `Any`."""

    images: Sequence[Callable[[Any], Any]]

    def read(self, diagram: Diagram) -> Any: ...
    def write(self, states: Any) -> Diagram: ...
    def union(self, a: Any, b: Any) -> Any: ...
    def difference(self, a: Any, b: Any) -> Any: ...
    def is_empty(self, a: Any) -> bool: ...


def _closure(symbolic: SymbolicModel, sets: _Sets, start: Diagram) -> tuple[Diagram, int]:
    """The closure of `start` under the images, and the number of breadth-first steps."""
    reached = frontier = sets.read(start)
    iterations = 0
    while not sets.is_empty(frontier):
        found = frontier
        for image in sets.images:
            symbolic.manager.pause()
            found = sets.union(found, image(frontier))
        frontier = sets.difference(found, reached)
        reached = sets.union(reached, found)
        iterations += 1
    return sets.write(reached), iterations


class _KernelSets:
    """Sets as diagrams with leaves 0 and 1."""

    def __init__(self, relations: Sequence[TransitionRelation]) -> None:
        self.images: Sequence[Callable[[Any], Any]] = [self._image(relation) for relation in relations]

    @staticmethod
    def _image(relation: TransitionRelation) -> Callable[[Diagram], Diagram]:
        def image(states: Diagram) -> Diagram:
            current = states & relation.app
            for cluster in relation.clusters:
                current = current & cluster.relation
                tested = set(support(current))
                for level in cluster.quantified:
                    if level in tested:
                        current = sum_out(current, level)
            return move(current, relation.renaming)

        return image

    def read(self, diagram: Diagram) -> Diagram:
        return diagram

    def write(self, states: Diagram) -> Diagram:
        return states

    def union(self, a: Diagram, b: Diagram) -> Diagram:
        return a | b

    def difference(self, a: Diagram, b: Diagram) -> Diagram:
        return apply("difference", a, b)

    def is_empty(self, a: Diagram) -> bool:
        return a == a.manager.constant(0)


class _LibrarySets:
    """Sets as binary decision diagrams of dd."""

    def __init__(
        self, sets: BooleanSets, symbolic: SymbolicModel, relations: Sequence[TransitionRelation]
    ) -> None:
        self.sets = sets
        self.valid_now = sets.valid(symbolic.now_levels)
        self.images: Sequence[Callable[[Any], Any]] = [self._image(relation) for relation in relations]

    def _image(self, relation: TransitionRelation) -> Callable[[Any], Any]:
        sets = self.sets
        app = sets.from_diagram(relation.app)
        clusters = [
            (sets.from_diagram(cluster.relation) & sets.valid(cluster.drawn), cluster.quantified)
            for cluster in relation.clusters
        ]

        def image(states: Any) -> Any:
            current = states & app
            for condition, levels in clusters:
                current = sets.and_exists(current, condition, levels)
            return sets.move(current, relation.renaming)

        return image

    def read(self, diagram: Diagram) -> Any:
        return self.sets.from_diagram(diagram) & self.valid_now

    def write(self, states: Any) -> Diagram:
        return self.sets.to_diagram(states)

    def union(self, a: Any, b: Any) -> Any:
        return a | b

    def difference(self, a: Any, b: Any) -> Any:
        return a & ~b

    def is_empty(self, a: Any) -> bool:
        return bool(a == self.sets.bdd.false)


def uniform_rows(symbolic: SymbolicModel) -> dict[int, RowDiagram]:
    """The uniform distribution over all states, as the rows of an initial belief."""
    zero = symbolic.manager.constant(0)
    shares = [Fraction(1, len(feature.values)) for feature in symbolic.model.features]
    return {i: RowDiagram(i, zero, ((q,) * int(1 / q),)) for i, q in enumerate(shares)}
