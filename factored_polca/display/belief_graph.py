"""A policy over beliefs as a graph: a node for each belief that it meets, an arc for what may be observed.

From the initial belief on, each belief is followed through what may be observed,

    b'(t) ~ sum over s of b(s) K_a(s; t, o),   a the policy's action at b,

restricted to what is seen of the state and to the episode going on.  Beliefs whose probabilities agree to
`DIGITS` decimals, and that call for the same action, are one node (of policies for a finite horizon, at the
same step).  A policy graph has its own nodes; each shows the belief at which it is first reached.  Nodes
are followed in the order of how likely they are reached: of a large graph the likeliest part is shown.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, Final, TypeAlias

import numpy as np

from factored_polca.diagrams import pairs
from factored_polca.display.graphs import Edge, Graph, Node
from factored_polca.display.words import listed, percent, plural, short, value_text
from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policies import horizon_of
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation import Partition
from factored_polca.models import Feature

SHOWN_NODES: Final = 24
SHOWN_HYPOTHESES: Final = 3
DIGITS: Final = 6

LARGEST: Final = 20_000
"""Entries (action, observation) times states up to which beliefs are followed."""

BeliefPolicy: TypeAlias = AlphaVectors | StagedVectors | EntropyPolicy | PolicyGraph
Describe: TypeAlias = Callable[[FloatArray], Sequence[str]]
"""What is said of a belief [s], in a few lines."""


@dataclass(frozen=True)
class Met:
    """A node: a belief that is met, the action there, and how likely it is reached the first time."""

    key: str
    belief: FloatArray  # [s]
    action: int  # -1: nothing is done
    chance: float
    step: int
    node: int = -1  # of a policy graph


def policy_graph(
    pomdp: ArrayPOMDP, policy: BeliefPolicy, describe: Describe, most: int = SHOWN_NODES
) -> Graph:
    """The policy from the initial belief on, at most so many nodes of it."""
    walk = _Walk(pomdp, policy)
    nodes, edges = [], list[Edge]()
    met: dict[str, Met] = {}
    cut: set[str] = set()
    heap: list[tuple[float, int, Met]] = []
    for one in walk.start():
        met[one.key] = one
        heapq.heappush(heap, (-one.chance, len(met), one))
    shown: list[Met] = []
    while heap:
        _, _, here = heapq.heappop(heap)
        if len(shown) == most:
            cut.add(here.key)
            continue
        shown.append(here)
        labels: dict[str, list[tuple[str, float]]] = {}
        for label, chance, after in walk.after(here):
            key = "ended" if after is None else after.key
            labels.setdefault(key, []).append((label, chance))
            if after is not None and key not in met:
                met[key] = after
                heapq.heappush(heap, (-after.chance, len(met), after))
        edges += [Edge(here.key, key, _label(found), title=_title(found)) for key, found in labels.items()]
    for one in shown:
        name = pomdp.actions[one.action] if one.action >= 0 else "nothing"
        nodes.append(Node(one.key, (short(name), *describe(one.belief)), "belief", _hint(one)))
    targets = {edge.target for edge in edges}
    if "ended" in targets:
        nodes.append(Node("ended", ("ended",), "terminal", heading=False))
    if cut & targets:
        edges = [
            Edge(e.source, "more" if e.target in cut else e.target, e.label, title=e.title) for e in edges
        ]
        nodes.append(Node("more", ("…",), "more", "beliefs that are not shown", heading=False))
    note = f"shown: the {most} beliefs that are likeliest reached" if cut & targets else ""
    return Graph(
        tuple(nodes), tuple(edges), "Policy graph: actions at beliefs, observations on arcs", "auto", note
    )


def _label(found: Sequence[tuple[str, float]]) -> str:
    names = [brief(name) for name, _ in sorted(found, key=lambda pair: -pair[1]) if name]
    return listed(dict.fromkeys(names), 3, " | ")


def brief(label: str) -> str:
    """A joint observation without the channels that report nothing, as long as one reports something."""
    parts = label.split(", ")
    return ", ".join(part for part in parts if not part.endswith("=none")) or "none"


def _title(found: Sequence[tuple[str, float]]) -> str:
    return "; ".join(
        f"{name or 'nothing'} {percent(q)}" for name, q in sorted(found, key=lambda p: -p[1])[:20]
    )


def _hint(one: Met) -> str:
    node = f"node {one.node}; " if one.node >= 0 else ""
    return f"{node}first reached after {plural(one.step, 'step')}"


class _Walk:
    """Steps from belief to belief under a policy."""

    def __init__(self, pomdp: ArrayPOMDP, policy: BeliefPolicy) -> None:
        self.pomdp, self.policy = pomdp, policy
        self.staged = horizon_of(policy) is not None
        self.live: BoolArray = ~pomdp.terminal
        self.seen = np.unique(pomdp.observed[self.live])

    def start(self) -> list[Met]:
        """The initial belief, for each thing that may be seen of the state."""
        return [
            self.met(part, y, mass, 0, self.first_node(y))
            for y, mass, part in self.parts(self.pomdp.initial)
        ]

    def parts(self, weights: FloatArray) -> list[tuple[int, float, FloatArray]]:
        """What may be seen, its probability, and the belief then, of an unnormalised belief [s]."""
        found = []
        for y in self.seen.tolist():
            part = np.where(self.live & (self.pomdp.observed == y), weights, 0.0)
            mass = float(part.sum())
            if mass > 1e-12:
                found.append((y, mass, part / mass))
        return found

    def first_node(self, y: int) -> int:
        """The first node of a policy graph."""
        return int(self.policy.start[y]) if isinstance(self.policy, PolicyGraph) else -1

    def met(self, belief: FloatArray, y: int, chance: float, step: int, node: int) -> Met:
        """A belief with its action and its key."""
        if isinstance(self.policy, PolicyGraph):
            action = int(self.policy.actions[node]) if node >= 0 else -1
            return Met(
                f"node {node} {y}" if node < 0 else f"node {node}", belief, action, chance, step, node
            )
        action = self.action(belief, step)
        rounded = np.round(belief, DIGITS) + 0.0
        stage = step if self.staged else 0
        return Met(
            f"{stage} {action} {blake2b(rounded.tobytes(), digest_size=16).hexdigest()}",
            belief,
            action,
            chance,
            step,
        )

    def action(self, belief: FloatArray, step: int) -> int:
        """The policy's action at a belief; none after the last step."""
        assert not isinstance(self.policy, PolicyGraph)
        horizon = horizon_of(self.policy)
        if horizon is not None and step >= horizon:
            return -1
        return int(self.policy.choose(belief[None, :], step)[0])

    def after(self, here: Met) -> list[tuple[str, float, Met | None]]:
        """What may be observed, with its probability, and what is met then; None: the episode has ended."""
        found: list[tuple[str, float, Met | None]] = []
        if here.action < 0:
            return found
        names = self.pomdp.observations[here.action]
        ended = 0.0
        for o, matrix in enumerate(self.pomdp.kernel[here.action]):
            weights = np.asarray(here.belief @ matrix)
            ended += float(weights[self.pomdp.terminal].sum())
            for y, mass, belief in self.parts(weights):
                node = self.next_node(here, o, y)
                label = names[o] if len(names) > 1 else ""
                after = self.met(belief, y, here.chance * mass, here.step + 1, node)
                found.append((label, mass, after))
        if ended > 1e-12:
            found.append(("", ended, None))
        return found

    def next_node(self, here: Met, o: int, y: int) -> int:
        """The successor in a policy graph."""
        if not isinstance(self.policy, PolicyGraph) or here.node < 0:
            return -1
        return int(self.policy.successors[here.node][o, y])


def followable(pomdp: ArrayPOMDP) -> bool:
    """Whether the beliefs of a problem are few enough numbers to be followed while someone waits."""
    columns = sum(len(names) for names in pomdp.observations)
    return columns * pomdp.states <= LARGEST * 50


def by_feature(features: Sequence[Feature], states: IntArray) -> Describe:
    """What is said of a belief over listed states [s, feature]: the features that are not certain."""

    def describe(belief: FloatArray) -> list[str]:
        lines = []
        for number, feature in enumerate(features):
            chances = np.bincount(states[:, number], weights=belief, minlength=len(feature.values))
            order = [v for v in np.argsort(-chances, kind="stable").tolist() if chances[v] > 0.0005]
            if len(order) > 1:
                said = [f"{value_text(feature.values[v])} {percent(float(chances[v]))}" for v in order]
                lines.append(short(f"{feature.name}: {listed(said, SHOWN_HYPOTHESES)}", 60))
        if not lines:
            state = states[int(belief.argmax())]
            values = [
                f"{f.name}={value_text(f.values[v])}" for f, v in zip(features, state.tolist(), strict=True)
            ]
            return [short(f"certain: {', '.join(values)}", 48)]
        more = [f"… {plural(len(lines) - 4, 'more feature')}"] if len(lines) > 4 else []
        return [*lines[:4], *more]

    return describe


def by_partition(partition: Partition, texts: Sequence[str]) -> Describe:
    """What is said of a belief over blocks: uncertain features that blocks decide, else likely blocks."""
    symbolic = partition.symbolic
    decided = [k for k in range(len(symbolic.model.features)) if _decides(partition, k)]
    features = [symbolic.model.features[k] for k in decided]
    states = partition.representatives[:, [symbolic.now(k) for k in decided]].astype(np.int64)
    told, blocks = by_feature(features, states), by_block(texts)

    def describe(belief: FloatArray) -> Sequence[str]:
        spread = states[belief > 0.0005]
        return told(belief) if len(spread) > 1 and (spread != spread[0]).any() else blocks(belief)

    return describe


def _decides(partition: Partition, feature: int) -> bool:
    """Whether each block has one value of a feature."""
    symbolic, manager = partition.symbolic, partition.symbolic.manager
    level = symbolic.now(feature)
    value = manager.variable(level, [manager.constant(v) for v in range(manager.sizes[level])])
    _, first, _ = pairs(partition.diagram, value)
    return len(first) == len(set(first.tolist()))


def by_block(texts: Sequence[str]) -> Describe:
    """What is said of a belief over blocks: the likeliest ones."""

    def describe(belief: FloatArray) -> list[str]:
        order = [k for k in np.argsort(-belief, kind="stable").tolist() if belief[k] > 0.0005]
        lines = [f"{percent(float(belief[k]))} {short(texts[k], 44)}" for k in order[:SHOWN_HYPOTHESES]]
        left = len(order) - SHOWN_HYPOTHESES
        return [*lines, *([f"… {plural(left, 'more block')}"] if left > 0 else [])]

    return describe


def unfolds(policy: Any) -> bool:
    """Whether something is a policy over beliefs."""
    return isinstance(policy, (AlphaVectors, StagedVectors, EntropyPolicy, PolicyGraph))
