"""Solving a partially observed model on diagrams: the anytime solver, its result, and its policy.

No state is listed and no quotient made: beliefs are products of marginals where that is exact, and
alpha-vectors are diagrams (Symbolic Perseus; Poupart 2005), here with an upper bound as well
(`pomdp_search`).  What limits it are the nodes of diagrams, alpha-vectors, beliefs, memory and time; each
limit ends it with the bounds and the policy so far.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

from factored_polca.diagrams import Aborted, Diagram, MemoryLimit, node_count
from factored_polca.models import LimitReached, ModelError
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.interrupts import interrupts_at_polls
from factored_polca.solvers.pomdp_result import Bounds, Demand
from factored_polca.solvers.result import Guarantee, Status
from factored_polca.structured.pomdp_belief import BELIEF_ERROR, BeliefSpace
from factored_polca.structured.pomdp_bounds import FirstBounds, Sizes
from factored_polca.structured.pomdp_cell_bounds import first_bounds
from factored_polca.structured.pomdp_corners import Corners
from factored_polca.structured.pomdp_informed import informed_bound
from factored_polca.structured.pomdp_lower import Alpha, AlphaSet, LowerBound, closure
from factored_polca.structured.pomdp_model import FactoredPOMDP, Seen
from factored_polca.structured.pomdp_point import PointBelief
from factored_polca.structured.pomdp_search import SHARE, Node, Search, TooManyBeliefs
from factored_polca.structured.pomdp_upper import UpperBound
from factored_polca.symbolic import SymbolicModel
from factored_polca.symbolic.reach import uniform_rows

METHOD: Final = "point-based value iteration on diagrams"

NODE_LIMIT: Final = 20_000
"""Nodes of a bound over all states, beyond which its leaves are merged."""

ALPHA_NODES: Final = 4_000
"""The same of an alpha-vector at one y."""

ASKED_NODES: Final = 1_000_000
"""Nodes of a belief at which a policy is asked."""

BELIEF_LIMIT: Final = 1_000_000
"""Beliefs that may be explored."""

BLIND_SECONDS: Final = 20.0
QMDP_SECONDS: Final = 60.0
INFORMED_SECONDS: Final = 120.0
"""How long the first bounds may take, where that is less than their share of the time given."""

UNIFORM: Final = 100
"""Values of what is seen, up to which the uniform belief is one to start from at each of them."""

MERGED: Final = 0.1
"""Leaves are merged within this share of gap * (1 - discount), which is what merging then costs."""


@dataclass(frozen=True, eq=False)
class AlphaDiagrams:
    """A policy: at a belief the action of the best alpha-vector, one set for each value of what is seen.

    `blind` are alpha-vectors over the whole state, for any y; `slices` [y] those over the hidden features.
    """

    symbolic: SymbolicModel
    blind: tuple[tuple[int, Diagram], ...]
    slices: Mapping[Seen, tuple[Alpha, ...]]
    _sets: dict[Seen, AlphaSet] = field(default_factory=dict, repr=False)

    @cached_property
    def space(self) -> BeliefSpace:
        """Beliefs to ask it at."""
        return BeliefSpace(FactoredPOMDP(self.symbolic), cluster_nodes=ASKED_NODES)

    @property
    def vectors(self) -> int:
        """How many alpha-vectors it has."""
        return len(self.blind) + sum(len(alphas) for alphas in self.slices.values())

    @property
    def nodes(self) -> int:
        """The nodes of all its diagrams."""
        found = sum(node_count(diagram) for _, diagram in self.blind)
        return found + sum(node_count(a.diagram) for alphas in self.slices.values() for a in alphas)

    def at(self, seen: Seen) -> AlphaSet:
        """The alpha-vectors at one y."""
        if seen not in self._sets:
            pomdp = self.space.pomdp
            blind = [Alpha(seen, a, pomdp.at(seen, d), blind=True) for a, d in self.blind]
            self._sets[seen] = AlphaSet(pomdp, [*blind, *self.slices.get(seen, ())])
        return self._sets[seen]

    def choose(self, belief: PointBelief) -> int:
        """The number of the action at a belief."""
        known = self.at(belief.seen)
        values = self.space.expectations(belief, known.forest)
        return known.alphas[int(values.argmax())].action

    def value(self, belief: PointBelief) -> float:
        """What the policy earns at least from a belief on, but for rounding."""
        return float(self.space.expectations(belief, self.at(belief.seen).forest).max())


@dataclass(frozen=True, eq=False)
class SymbolicSolution:
    """Bounds on V*(b0), and a policy whose value is at least `lower`.

    `lower <= V*(b0) <= upper` whatever the status, rounding and merging included.  `projections` counts the
    outcomes whose beliefs were too large to be formed, so that the upper bound learnt nothing from them.
    `corner_gap`, where it was solved everywhere, is the largest upper - lower at the corners, the uniform
    belief and the initial one.
    """

    lower: float
    upper: float
    policy: AlphaDiagrams
    status: Status
    guarantee: Guarantee
    method: str
    vectors: int
    beliefs: int
    seen: int  # values of the observed features that were met
    backups: int
    projections: int
    iterations: int  # trials
    seconds: float
    history: tuple[Bounds, ...]
    note: str
    corner_gap: float | None = None

    @property
    def gap(self) -> float:
        """upper - lower."""
        return self.upper - self.lower

    @property
    def converged(self) -> bool:
        """Whether the gap asked for was reached."""
        return self.status == "converged"


class _Run:
    """The state of a run: what is there when it is stopped."""

    def __init__(self, symbolic: SymbolicModel, demand: Demand, node_limit: int, belief_limit: int) -> None:
        self.began = time.monotonic()
        self.demand = demand
        self.pomdp = FactoredPOMDP(symbolic)
        self.space = BeliefSpace(self.pomdp)
        width = demand.gap * (1 - self.pomdp.discount) * MERGED
        self.alpha_nodes = min(node_limit, ALPHA_NODES)
        self.sizes = Sizes(node_limit if self.pomdp.observed else self.alpha_nodes, width)
        self.belief_limit = belief_limit
        self.first = FirstBounds(self.pomdp, self.sizes, demand.poll)
        self.blind: list[tuple[int, Diagram]] = [(0, self.first.constant(self.first.floor))]
        self.bounds = (self.first.floor, self.first.ceiling)
        self.search: Search | None = None
        self.corners: Corners | None = None
        self.others: list[Node] = []  # uniform beliefs
        self.trials = 0
        self.history: list[Bounds] = []
        self.notes: list[str] = []

    def note_bounds(self) -> None:
        """Keep the bounds that there are, the best ever."""
        if self.search is None:
            return
        lower, upper = self.search.bounds()
        self.bounds = (max(self.bounds[0], lower), min(self.bounds[1], upper))
        self.history.append(Bounds(time.monotonic() - self.began, *self.bounds))
        if self.demand.progress is not None:
            self.demand.progress(*self.bounds)

    def first_bounds(self) -> None:
        """Blind policies, QMDP and the fast informed bound."""
        left = self.demand.seconds_left
        starts = self.space.starts()

        def keep(blind: list[tuple[int, Diagram]]) -> None:
            self.blind = blind or self.blind
            lower = self._lower()
            error = 4 * self.first.size * BELIEF_ERROR
            value = sum(p * float(lower.values(belief).max()) for p, belief in starts) - error
            self.bounds = (max(self.bounds[0], value), self.bounds[1])

        quality, tables = first_bounds(
            self.first, min(BLIND_SECONDS, left / 10), min(QMDP_SECONDS, left / 4), keep
        )
        if tables:
            self.notes.append("the first bounds were found on tables of all states")
        left = self.demand.seconds_left
        seen = [belief.seen for _, belief in starts]
        informed = informed_bound(self.first, seen, quality, min(INFORMED_SECONDS, left / 4))
        upper = UpperBound(self.space, quality, self.first.size, informed, self.sizes.width)
        search = Search(
            self.space, self._lower(), upper, poll=self.demand.poll, belief_limit=self.belief_limit
        )
        search.roots = [(p, search.node(belief)) for p, belief in starts]
        self.search = search
        self.note_bounds()

    def _lower(self) -> LowerBound:
        """The alpha-vectors of blind policies."""
        return LowerBound(
            self.space,
            self.blind,
            self.first.size,
            nodes=self.alpha_nodes,
            width=self.sizes.width,
        )

    def improve_everywhere(self) -> Status:
        """Trials from the worst of the corners, the uniform belief and the start, until gaps are closed.

        A belief from which a trial changed nothing is given up.
        """
        search = self.search
        assert search is not None
        self.corners = corners = Corners(search)
        with suppress(LimitReached):
            for _, belief in self.space.starts(uniform_rows(self.pomdp.symbolic), UNIFORM):
                self.others.append(search.node(belief))
        waiting = [node for _, node in search.roots] + self.others
        while True:
            self.demand.poll()
            gap, node = corners.worst()
            at_corner = node is not None
            for other in waiting:
                if other.gap > gap:
                    gap, node, at_corner = other.gap, other, False
            if gap <= self.demand.gap or node is None:
                return "converged" if self.everywhere_gap() <= self.demand.gap else "rounding limit"
            if self.demand.iterations is not None and self.trials >= self.demand.iterations:
                return "iteration limit"
            before = node.lower, node.upper, len(search.nodes), search.backups
            search.trial(max(self.demand.gap / 2, node.gap * SHARE), node)
            self.trials += 1
            self.note_bounds()
            if at_corner:
                corners.learn(node)
            if (node.lower, node.upper, len(search.nodes), search.backups) == before:
                if at_corner:
                    corners.give_up(node)
                else:
                    waiting.remove(node)

    def everywhere_gap(self) -> float:
        """The largest gap at the corners, the uniform belief and the start, of the policy so far."""
        if self.corners is None or self.search is None:
            return self.first.ceiling - self.first.floor
        gaps = [node.gap for node in self.others] + [self.bounds[1] - self.bounds[0]]
        return max(self.corners.gap(self.policy()), *gaps)

    def improve(self) -> Status:
        """Trials until the gap, or the limit of iterations, is reached."""
        search = self.search
        assert search is not None
        while True:
            gap = self.bounds[1] - self.bounds[0]
            if gap <= self.demand.gap or not search.roots:
                return "converged"
            if self.demand.iterations is not None and self.trials >= self.demand.iterations:
                return "iteration limit"
            before = self.bounds, len(search.nodes), search.backups
            search.trial(max(self.demand.gap / 2, gap * SHARE))
            self.trials += 1
            self.note_bounds()
            if (self.bounds, len(search.nodes), search.backups) == before and self._stuck(gap):
                return "rounding limit"

    def _stuck(self, gap: float) -> bool:
        """Whether trials of any aim change nothing."""
        search = self.search
        assert search is not None
        for target in (self.demand.gap / 2, 0.0):
            before = self.bounds, len(search.nodes), search.backups
            for _ in range(4):
                search.trial(target)
                self.trials += 1
            self.note_bounds()
            if (self.bounds, len(search.nodes), search.backups) != before:
                return False
        return True

    def policy(self) -> AlphaDiagrams:
        """The alpha-vectors that are in use, and those that they go on with."""
        slices: dict[Seen, list[Alpha]] = {}
        if self.search is not None:
            lower = self.search.lower
            used: list[Alpha] = []
            for known in lower.sets.values():
                for alpha in known.alphas:
                    if not alpha.blind:
                        used.append(alpha)
            for alpha in closure(used):
                if not alpha.blind:
                    slices.setdefault(alpha.seen, []).append(alpha)
        return AlphaDiagrams(
            self.pomdp.symbolic, tuple(self.blind), {y: tuple(alphas) for y, alphas in slices.items()}
        )


@contextmanager
def _deadline(symbolic: SymbolicModel, deadline: float | None) -> Iterator[None]:
    """The manager's operations end at a deadline."""
    before = symbolic.manager.deadline
    symbolic.manager.deadline = deadline
    try:
        yield
    finally:
        symbolic.manager.deadline = before


def solve_symbolic(
    symbolic: SymbolicModel,
    demand: Demand,
    *,
    node_limit: int = NODE_LIMIT,
    belief_limit: int = BELIEF_LIMIT,
    everywhere: bool = False,
) -> SymbolicSolution:
    """Bounds on the optimal value of a partially observed model, and a policy, without listing its states.

    `demand.iterations` counts trials.  `everywhere` asks for the gap at all corners and at the uniform
    belief as well, and not only at the initial one.

    Raises:
        ModelError: a fully observed model, a finite horizon, or a discount of 1.
        LimitReached: too many joint observations for an action, or too many values of what is seen.
    """
    if node_limit < 1 or belief_limit < 1:
        raise ModelError("the limits of nodes and beliefs must be at least 1")
    run = _Run(symbolic, demand, node_limit, belief_limit)
    status: Status
    with interrupts_at_polls(), _deadline(symbolic, demand.deadline):
        try:
            run.first_bounds()
            status = run.improve_everywhere() if everywhere else run.improve()
        except (TimeIsUp, Aborted):
            status = "time limit"
        except KeyboardInterrupt:
            status = "interrupted"
        except (MemoryLimit, TooManyBeliefs) as error:
            status = "memory limit"
            run.notes.append(_limit_text(error, belief_limit))
    with symbolic.manager.undisturbed():
        return _finished(run, status, everywhere)


def _limit_text(error: Exception, belief_limit: int) -> str:
    if isinstance(error, TooManyBeliefs):
        return f"all of the {belief_limit:,} beliefs that are allowed were met"
    return str(error)


def _finished(run: _Run, status: Status, everywhere: bool) -> SymbolicSolution:
    if run.search is not None:
        lower, upper = run.search.bounds()
        run.bounds = (max(run.bounds[0], lower), min(run.bounds[1], upper))
    lower, upper = run.bounds
    policy = run.policy()
    search, space = run.search, run.space
    notes = ["solved on diagrams: no state was listed", *run.notes]
    if space.projections:
        notes.append(
            f"{space.projections:,} beliefs had too many nodes and were projected on their marginals: "
            "from them the upper bound learnt nothing"
        )
    loss = 0.0 if search is None else search.lower.loss
    if loss > 2 * run.sizes.width:
        notes.append(
            f"alpha-vectors were merged down to {run.alpha_nodes:,} nodes, at up to {loss:.2g} a backup"
        )
    text = (
        "the optimal value lies between the bounds, and the policy earns at least the lower one; "
        "rounding and merged leaves are accounted for"
    )
    return SymbolicSolution(
        lower, upper, policy, status, Guarantee("bounds", text), METHOD, policy.vectors,
        0 if search is None else len(search.nodes), 0 if search is None else len(search.lower.sets),
        0 if search is None else search.backups, space.projections, run.trials,
        time.monotonic() - run.began, tuple(run.history), "; ".join(notes),
        run.everywhere_gap() if everywhere else None,
    )  # fmt: skip
