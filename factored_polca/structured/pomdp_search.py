"""Point-based value iteration with two bounds, by trials (HSVI2, Smith & Simmons 2005; SARSOP, Kurniawati,
Hsu & Lee 2008), all functions being diagrams.

A *node* is a belief that was met, with a lower and an upper bound.  A trial goes down from the initial
belief: the action with the best upper bound, then the outcome with the largest

    p(o) (upper - lower - target * discount^-depth),

until no such excess is left, and comes back making a point-based backup of both bounds at every node.

Actions are expanded when they are needed: at first an action's upper bound is its base bound, and while the
best one has not been expanded it is.  An action some outcome of which leads to a *projected* belief
(`pomdp_belief`) keeps its base bound; its outcomes still serve the lower bound.  Where the upper bound
can't be improved for that reason, trials go by the lower bound every second time, and all actions that may
be the best are expanded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from factored_polca.diagrams import MemoryLimit
from factored_polca.diagrams.manager import available_memory
from factored_polca.structured.pomdp_belief import BELIEF_ERROR, BeliefSpace
from factored_polca.structured.pomdp_lower import Alpha, LowerBound
from factored_polca.structured.pomdp_model import UNIT, Seen, Step
from factored_polca.structured.pomdp_point import FloatArray, PointBelief
from factored_polca.structured.pomdp_upper import UpperBound

DEEPEST: Final = 400
"""Steps of a trial."""

SHARE: Final = 0.8
"""A trial aims at this share of the gap that there is."""

LOOKED_AT: Final = 500
SPARE: Final = 256 << 20
"""Each time so many beliefs were added, so many bytes must be free."""

PRUNE_AT: Final = 60
"""Alpha-vectors of one y beyond those kept, before the useless ones are set aside."""


@dataclass(eq=False)
class Expansion:
    """What follows a node under an action; None stands for an impossible outcome."""

    step: Step
    reward: float
    chances: list[float]
    children: list[Node | None]
    exact: bool


@dataclass(eq=False)
class Node:
    """A belief that was met; `quality` [action] are base bounds, `uppers` [action] the best ones known."""

    belief: PointBelief
    quality: FloatArray
    uppers: FloatArray
    lower: float
    upper: float
    best: Alpha
    looked: int  # alpha-vectors of its y looked at, of this version of the set
    version: int
    seen_points: int = 0  # entries of the log of points looked at
    point: int = -1  # its number among the points of the upper bound
    visits: int = 0
    expanded: dict[int, Expansion] = field(default_factory=dict)

    @property
    def gap(self) -> float:
        """upper - lower."""
        return self.upper - self.lower


class Search:
    """The nodes, the two bounds, and trials."""

    def __init__(
        self,
        space: BeliefSpace,
        lower: LowerBound,
        upper: UpperBound,
        *,
        poll: Callable[[], None],
        belief_limit: int,
    ) -> None:
        self.space, self.lower, self.upper = space, lower, upper
        self.poll, self.belief_limit = poll, belief_limit
        self.discount = space.pomdp.discount
        size = lower.size
        self.read_error = (4 * space.entries + 4 * len(space.pomdp.hidden) + 32) * UNIT * size
        self.backup_error = size * BELIEF_ERROR + 2 * self.read_error
        self.nodes: dict[tuple[object, ...], Node] = {}
        self.by_seen: dict[Seen, list[Node]] = {}
        self.backups = 0
        self.roots: list[tuple[float, Node]] = []

    # -- nodes -----------------------------------------------------------------------------------

    def node(self, belief: PointBelief) -> Node:
        """The node of a belief, made where there is none."""
        key = belief.key()
        found = self.nodes.get(key)
        if found is None:
            if len(self.nodes) >= self.belief_limit:
                raise TooManyBeliefs
            if len(self.nodes) % LOOKED_AT == LOOKED_AT - 1 and available_memory() < SPARE:
                raise MemoryLimit(f"{len(self.nodes):,} beliefs and what is known of them fill the memory")
            quality = self.space.expectations(belief, self.upper.at(belief.seen).forest)
            quality = quality + self.read_error
            values = self.lower.values(belief)
            chosen = int(values.argmax())
            found = Node(
                belief, quality, quality.copy(), float(values[chosen]) - self.read_error,
                float(quality.max()), self.lower.at(belief.seen).alphas[chosen], len(values),
                self.lower.at(belief.seen).version,
            )  # fmt: skip
            self.nodes[key] = found
            self.by_seen.setdefault(belief.seen, []).append(found)
        return found

    def refresh_lower(self, node: Node) -> None:
        """The lower bound of a node from alpha-vectors that it has not seen."""
        alphas = self.lower.at(node.belief.seen)
        since = node.looked if node.version == alphas.version else 0
        if since < len(alphas.alphas):
            values = self.lower.values(node.belief, since)
            chosen = int(values.argmax())
            value = float(values[chosen]) - self.read_error
            if value > node.lower:
                node.lower, node.best = value, alphas.alphas[since + chosen]
            node.looked, node.version = len(alphas.alphas), alphas.version

    def refresh_upper(self, node: Node) -> None:
        """The upper bound of a node from points that it has not seen."""
        points = self.upper.at(node.belief.seen)
        if len(points.log) > node.seen_points:
            bound = points.bound(node.belief, node.quality, node.seen_points) + self.read_error
            node.upper = min(node.upper, bound)
            node.seen_points = len(points.log)

    def expand(self, node: Node, action: int) -> Expansion:
        """What follows a node under an action."""
        found = node.expanded.get(action)
        if found is None:
            self.poll()
            reward, follows = self.space.follow(node.belief, action)
            step = self.space.tables(node.belief.seen, action).step
            found = Expansion(
                step,
                reward,
                [0.0 if f is None else f.probability for f in follows],
                [None if f is None else self.node(f.belief) for f in follows],
                all(f is None or f.exact for f in follows),
            )
            node.expanded[action] = found
            self._improve_upper(node, action, found)
        return found

    def _improve_upper(self, node: Node, action: int, expansion: Expansion) -> None:
        if not expansion.exact:
            return
        after = 0.0
        for chance, child in zip(expansion.chances, expansion.children, strict=True):
            if child is not None:
                self.refresh_upper(child)
                after += chance * child.upper
        bound = expansion.reward + self.discount * after + self.backup_error
        node.uppers[action] = min(float(node.uppers[action]), bound)

    # -- backups ---------------------------------------------------------------------------------

    def backup_upper(self, node: Node) -> None:
        """The upper bound of a node, from those of what follows the actions that were expanded."""
        while True:
            action = int(node.uppers.argmax())
            fresh = action not in node.expanded
            expansion = self.expand(node, action)
            if not fresh:
                before = float(node.uppers[action])
                self._improve_upper(node, action, expansion)
                fresh = float(node.uppers[action]) < before
            if not fresh or int(node.uppers.argmax()) == action:
                break
        bound = float(node.uppers.max())
        points = self.upper.at(node.belief.seen)
        if bound < node.upper:
            node.upper = bound
        if node.upper < float(node.quality.max()):
            if node.point < 0:
                node.point = points.add(node.belief, node.quality, node.upper)
            elif node.upper < float(points.values[node.point]):
                points.lower_to(node.point, node.upper)

    def backup_lower(self, node: Node) -> None:
        """A new alpha-vector for a node, where it is of use there."""
        best, chosen = -np.inf, -1
        for action in sorted(node.expanded, key=lambda a: -node.uppers[a]):
            if node.uppers[action] <= best:
                break
            expansion = node.expanded[action]
            value = 0.0
            for chance, child in zip(expansion.chances, expansion.children, strict=True):
                if child is not None:
                    self.refresh_lower(child)
                    value += chance * child.lower
            value = expansion.reward + self.discount * value
            if value > best:
                best, chosen = value, action
        self.refresh_lower(node)
        if not best > node.lower + 4 * self.read_error:
            return
        expansion = node.expanded[chosen]
        alphas = [
            self.lower.at(outcome.seen).alphas[0] if child is None else child.best
            for outcome, child in zip(expansion.step.outcomes, expansion.children, strict=True)
        ]
        alpha = self.lower.backup(expansion.step, alphas)
        self.backups += 1
        known = self.lower.at(node.belief.seen)
        known.add(alpha)
        self.refresh_lower(node)
        if len(known.alphas) > 2 * known.kept + PRUNE_AT:
            self.prune(node.belief.seen)

    def prune(self, seen: Seen) -> None:
        """Leave those alpha-vectors of one y that are the best at some node."""
        known = self.lower.at(seen)
        numbers = {id(alpha): n for n, alpha in enumerate(known.alphas)}
        used = {n for n, alpha in enumerate(known.alphas) if alpha.blind}
        for node in self.by_seen.get(seen, ()):
            self.refresh_lower(node)
            if id(node.best) in numbers:
                used.add(numbers[id(node.best)])
        known.keep(sorted(used))
        for node in self.by_seen.get(seen, ()):
            node.looked, node.version = len(known.alphas), known.version

    # -- trials ----------------------------------------------------------------------------------

    def trial(self, target: float, root: Node | None = None) -> None:
        """One trial from `root`, or from the part of the start with the largest excess."""
        node = root
        if node is None:
            _, node = max(self.roots, key=lambda root: root[0] * (root[1].gap - target))
        path: list[Node] = []
        aim = target
        for _ in range(DEEPEST):
            self.poll()
            path.append(node)
            node.visits += 1
            self.backup_upper(node)
            action = int(node.uppers.argmax())
            expansion = node.expanded[action]
            if not expansion.exact:
                action = self._by_lower(node, action)
                expansion = node.expanded[action]
            aim /= self.discount
            most, following = 0.0, None
            for chance, child in zip(expansion.chances, expansion.children, strict=True):
                if child is not None:
                    self.refresh_lower(child)
                    self.refresh_upper(child)
                    excess = chance * (child.gap - aim)
                    if excess > most:
                        most, following = excess, child
            if following is None:
                break
            node = following
        for node in reversed(path):
            self.poll()
            self.backup_lower(node)
            self.backup_upper(node)

    def _by_lower(self, node: Node, action: int) -> int:
        """An action where the upper bound does not tell: every second time the best known one."""
        for other in range(len(node.uppers)):
            if node.uppers[other] > node.lower:
                self.expand(node, other)
        if node.visits % 2:
            return action
        return max(node.expanded, key=lambda a: self._value(node.expanded[a]))

    def _value(self, expansion: Expansion) -> float:
        pairs = zip(expansion.chances, expansion.children, strict=True)
        after = sum(chance * child.lower for chance, child in pairs if child is not None)
        return expansion.reward + self.discount * after

    # -- the start -------------------------------------------------------------------------------

    def bounds(self) -> tuple[float, float]:
        """Bounds on the value of the initial belief."""
        error = self.backup_error
        lower = sum(p * node.lower for p, node in self.roots) - error
        upper = sum(p * node.upper for p, node in self.roots) + error
        return lower, upper


class TooManyBeliefs(RuntimeError):
    """More beliefs than were allowed."""
