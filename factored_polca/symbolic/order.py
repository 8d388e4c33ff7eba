"""Variable orders: which feature stands at which level.

The size of diagrams depends on the order.  Heuristics work on the two-slice graph: an edge joins two
features where one is a parent of the other under some action, or where both occur in one reward
term, one channel's distribution or one condition.

    file    the order of the model
    force   barycentres: each feature moves to the mean position of the terms it occurs in, repeated
            (Aloul, Markov & Sakallah 2003, "FORCE"); the order of least total span is kept
    spectral the Fiedler vector of the graph sorted (Juvan & Mohar 1992)
    auto    of these and their reversals the one of least total span and least *pull upwards*

The span of a group of features is the distance from its first to its last; the sum of spans over
all groups is what the heuristics make small.  An order and its reversal have equal spans, but seldom
equal costs.  Regression works from the bottom up: at a node of x_i it multiplies the children's results
by P_a(x_i' | parents).  Where the parents stand below x_i the product is one of diagrams below it; where
they stand above, results of nodes far down depend on features far up, and each product above them runs
through all they have grown to.  So each arc whose parent stands above its child counts 1 + its length;
that is the pull upwards, over the actions.  (Measured: tests/benchmarks/orders.py.)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import networkx as nx
import numpy as np

from factored_polca.models import Model, TaskHierarchy
from factored_polca.models.expressions import Expression, references

ORDERS: Final = ("auto", "file", "force", "spectral")
"""Names of the heuristics."""

Group = frozenset[str]
Arcs = Mapping[tuple[str, str], int]
"""How many actions have an arc from one feature (the parent, of now or next) to another, the child."""


def groups(model: Model, tasks: TaskHierarchy | None = None) -> list[Group]:
    """Sets of features that belong close together: each conditional distribution with its child,
    each reward term, each condition."""
    known = {feature.name for feature in model.features}
    found: list[Group] = []

    def add(expression: Expression, *names: str) -> None:
        group = frozenset({r.name for r in references(expression)} & known | set(names))
        if len(group) > 1:
            found.append(group)

    for action in model.actions:
        for name, effect in action.effects:
            add(effect, name)
        add(action.applicable)
        for _, sensed in action.senses:
            add(sensed)
        for term in action.rewards:
            add(term)
    for term in model.rewards:
        add(term)
    add(model.terminal)
    for task in tasks.tasks if tasks else ():
        add(task.terminal)
    return found


def two_slice_graph(model: Model) -> nx.DiGraph:
    """The graph whose edges lead from parents (`x` or `x'`) to next features (`x'`), over all actions."""
    graph = nx.DiGraph()
    for feature in model.features:
        graph.add_edge(feature.name, f"{feature.name}'", persists=True)
    for action in model.actions:
        for name, effect in action.effects:
            for reference in references(effect):
                parent = f"{reference.name}'" if reference.primed else reference.name
                graph.add_edge(parent, f"{name}'")
    return graph


def total_span(order: Sequence[str], found: Iterable[Group]) -> int:
    """The sum over groups of the distance from the first to the last member."""
    position = {name: index for index, name in enumerate(order)}
    total = 0
    for group in found:
        places = [position[name] for name in group]
        total += max(places) - min(places)
    return total


def parent_arcs(model: Model) -> Arcs:
    """The arcs between different features."""
    known = {feature.name for feature in model.features}
    return Counter(
        (parent, child)
        for action in model.actions
        for child, effect in action.effects
        for parent in {reference.name for reference in references(effect)} & known - {child}
    )


def pull_upwards(order: Sequence[str], arcs: Arcs) -> int:
    """The sum over arcs whose parent stands above its child of 1 + the distance between them."""
    position = {name: index for index, name in enumerate(order)}
    down = {arc: position[arc[1]] - position[arc[0]] for arc in arcs}
    return sum(count * (1 + down[arc]) for arc, count in arcs.items() if down[arc] > 0)


def force(order: Sequence[str], found: Sequence[Group]) -> list[str]:
    """Improve `order` by moving each feature to the mean of its groups' centres, until it stops."""
    best = list(order)
    current = best
    best_span = total_span(best, found)
    for _ in range(10 + 5 * len(best).bit_length()):
        position = {name: index for index, name in enumerate(current)}
        pulls: dict[str, list[float]] = {name: [] for name in current}
        for group in found:
            centre = sum(position[name] for name in group) / len(group)
            for name in group:
                pulls[name].append(centre)
        target = {n: sum(p) / len(p) if p else float(position[n]) for n, p in pulls.items()}
        following = sorted(current, key=lambda name: (target[name], position[name]))
        span = total_span(following, found)
        if span < best_span:
            best, best_span = following, span
        if following == current:
            break
        current = following
    return best


def spectral(order: Sequence[str], found: Sequence[Group]) -> list[str]:
    """Sort the features of each connected part by the Fiedler vector of the graph of groups."""
    graph = nx.Graph()
    graph.add_nodes_from(order)
    for group in found:
        members = sorted(group, key=list(order).index)
        weight = 1.0 / (len(members) - 1)
        for i, a in enumerate(members):
            for b in members[i + 1 :]:
                old = graph.get_edge_data(a, b, {"weight": 0.0})["weight"]
                graph.add_edge(a, b, weight=old + weight)
    result: list[str] = []
    for component in nx.connected_components(graph):
        members = [name for name in order if name in component]
        if len(members) > 2:
            # networkx's own spectral_ordering iterates without end on some graphs
            _, vectors = np.linalg.eigh(nx.laplacian_matrix(graph, nodelist=members).toarray())
            fiedler = vectors[:, 1]  # of the second smallest eigenvalue
            members = [members[i] for i in np.argsort(fiedler, kind="stable")]
            if list(order).index(members[0]) > list(order).index(members[-1]):
                members.reverse()
        result.extend(members)
    return result


def variable_order(model: Model, name: str = "auto", tasks: TaskHierarchy | None = None) -> tuple[str, ...]:
    """The features from the top level down.

    Raises:
        ValueError: an unknown name; the message lists those there are.
    """
    given = [feature.name for feature in model.features]
    if name not in ORDERS:
        raise ValueError(f"no variable order {name!r}; there are {', '.join(ORDERS)}")
    found = groups(model, tasks)
    if name == "file" or not found or len(given) > 2_000:
        return tuple(given)
    if name == "force":
        return tuple(force(given, found))
    if name == "spectral":
        return tuple(spectral(given, found))
    candidates: list[list[str]] = [given, force(given, found)]
    if len(given) <= 200:
        candidates.append(force(spectral(given, found), found))
    candidates += [candidate[::-1] for candidate in candidates]
    arcs = parent_arcs(model)
    costs = [total_span(candidate, found) + pull_upwards(candidate, arcs) for candidate in candidates]
    return tuple(candidates[costs.index(min(costs))])
