"""The loop around the trials of HSVI2 and SARSOP: starting bounds, sweeps, limits, the result.

Start: blind policies below; above, the bound with delayed observations (TIB), its points included.
Then trials.  Whenever there are a tenth more vectors than before,

- Perseus' randomised backups run over all beliefs that were opened, a few rounds (both peers raise
  their lower bound along trials only, and stall there);
- now and then the vectors become controllers, and what these earn is added (`tree_evaluation`);
- vectors that are best at no opened belief, and points that were logged again since, leave the lists.

After each batch of trials a sweep carries upper bounds back through the graph of beliefs without
evaluating any anew, and now and then one that evaluates all of them: value iteration on the finite MDP
whose states are the opened beliefs, the idea of the augmented MDP (Poupart, Kim & Kim 2011).

*What the policy earns.*  A vector's links lead to the vectors that it was backed up from.  The policy
returned is a set of vectors closed under links.  At any belief b with the best vector alpha,
V(b) = alpha . b = r_j . b + gamma * sum_k alpha_k . (b M_k) <= r_j . b + gamma * sum_k V(b M_k), so by
induction over the steps the action of the best vector, taken at every step, earns at least V(b) from
every belief b (the first vectors are values of policies of their own, r_j . b + gamma * sum_k
alpha . (b M_k)).

Batches are counted in trials and vectors, never in seconds: equal demands give equal results.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.models.errors import ModelError
from factored_polca.solvers import tree_beliefs, tree_bounds
from factored_polca.solvers.belief_tree import (
    AT,
    BEST,
    FIRST_CHOICE,
    FIRST_LINK,
    LOG,
    LOWER,
    NEWEST_VECTOR,
    NODES,
    OF_CLASS,
    OLDER,
    OPTION,
    TRIALS,
    UPPER,
    VECTORS,
    for_points,
    for_vectors,
    grown,
    merge_widening,
    new_tree,
    room,
    size_in_bytes,
)
from factored_polca.solvers.blind import blind_vectors
from factored_polca.solvers.delayed import DelayedBound, delayed_bound
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.result import Guarantee, Status
from factored_polca.solvers.tree_evaluation import NARROW, Evaluator, with_controllers
from factored_polca.solvers.trials import ALL_CLOSE, NO_ROOM, TO_TIDY, TRIAL_STATE, search

MEMORY_LIMIT: Final = 6 << 30
"""Bytes that the tree may take unless a caller says otherwise."""
MAXIMUM_DEPTH: Final = 2000
FIRST_EVALUATION: Final = 400
"""Vectors before policy evaluation begins."""
MOST_POINTS: Final = 4000
"""Points of the delayed bound that are taken over, the most useful first."""


@dataclass(frozen=True)
class Style:
    """How a method searches; all counts are of trials."""

    name: str
    sarsop: bool
    turns: bool = False  # every other batch takes the other method's trials
    share: float = 0.95  # a trial's width, as a share of the widest gap at a root
    fine: float = 1e-3  # falls of an upper bound below this share of the trial's width make no point
    batch: int = 20
    evaluate_every: int = 100
    raising_rounds: int = 3
    tidy_factor: float = 1.05
    evaluation_factor: float = 1.5


@dataclass
class Search:
    """The working state of one run."""

    problem: Problem
    demand: Demand
    style: Style
    memory_limit: int
    began: float = field(default_factory=time.perf_counter)
    history: list[Bounds] = field(default_factory=list)
    evaluator: Evaluator | None = None

    def __post_init__(self) -> None:
        problem = self.problem
        vectors, options = blind_vectors(problem, self.demand)
        above = delayed_bound(problem, demand=self.demand)
        self.above = above
        self.stopped = above.status == "interrupted"
        self.least = room(problem)
        self.tree = new_tree(problem, vectors, options, above.corner_values, above.vectors, _depth(self))
        self.roots = np.array([self._node(root.y, root.belief) for root in problem.roots], dtype=np.int64)
        self._take_points(above)
        for node in self.roots.tolist():
            tree_bounds.refresh_upper(self.tree, node)
            tree_bounds.refresh_lower(self.tree, node)
        self.generator = np.random.default_rng(self.demand.seed)
        self.next_tidy = int(self.tree.counts[VECTORS]) + 50
        self.next_evaluation = int(self.tree.counts[VECTORS]) + FIRST_EVALUATION
        self.evaluated = 0
        self.slice = 1
        self.trial = np.zeros(TRIAL_STATE)
        self.note(tell=False)

    def _node(self, y: int, belief: FloatArray) -> int:
        states = np.flatnonzero(belief)
        self.tree = grown(self.tree, self.least)
        self.tree.touched[: len(states)] = states
        self.tree.dense[states] = belief[states]
        return tree_beliefs.find_or_add(self.problem.arrays, self.tree, y, 1.0, len(states))

    def _take_points(self, above: DelayedBound) -> None:
        """Make nodes of the points of the starting bound that say more than its corners."""
        problem, values = self.problem, above.point_values
        first = len(problem.states)
        base = np.zeros(len(values))
        offset = problem.arrays.offset[above.points.y]
        entries = np.repeat(np.arange(len(values)), np.diff(above.points.start))
        places = offset[entries] + above.points.column
        np.add.at(base, entries, above.points.weight * above.corner_values[places])
        drops = (base - values)[first:]
        useful = first + np.flatnonzero(drops > 1e-9 * max(1.0, float(np.abs(values).max(initial=0.0))))
        if len(useful) > MOST_POINTS:
            useful = useful[np.argsort(-(base - values)[useful], kind="stable")[:MOST_POINTS]]
        for point in useful.tolist():
            node = self._node(int(above.points.y[point]), above.belief(point))
            self.tree.bound[node, UPPER] = min(self.tree.bound[node, UPPER], values[point])
            tree_bounds.log_point(self.tree, node)

    # -- bounds --------------------------------------------------------------------------------

    @property
    def root_lower(self) -> FloatArray:
        """[root], rounding taken off."""
        lower: FloatArray = self.tree.bound[self.roots, LOWER] - self.problem.slack
        return lower

    @property
    def widening(self) -> float:
        """What rounding and merging may have taken off an upper bound."""
        return self.problem.slack + merge_widening(self.problem, self.tree)

    @property
    def root_upper(self) -> FloatArray:
        """[root], rounding and merging added."""
        upper: FloatArray = self.tree.bound[self.roots, UPPER] + self.widening
        return np.maximum(upper, self.root_lower)

    def note(self, *, tell: bool = True) -> None:
        """Write the bounds at b0 into the history, and tell who waits for them."""
        lower, upper = self.problem.combine(self.root_lower), self.problem.combine(self.root_upper)
        if self.history:
            lower, upper = max(lower, self.history[-1].lower), min(upper, self.history[-1].upper)
        if not self.history or (lower, upper) != (self.history[-1].lower, self.history[-1].upper):
            self.history.append(Bounds(time.perf_counter() - self.began, lower, upper))
        if tell and self.demand.progress is not None:
            self.demand.progress(lower, upper)

    # -- the loop ------------------------------------------------------------------------------

    def run(self, trials: int | None = None) -> Status:
        """Search until the gap is reached or a limit; `trials` in all, the demand's number by default.

        May be called again to go on.
        """
        limit = self.demand.iterations if trials is None else trials
        if self.stopped:  # Ctrl-C came while the starting bound was computed
            self.stopped = False
            return "interrupted"
        try:
            while True:
                self.demand.poll()
                if size_in_bytes(self.tree) > self.memory_limit:
                    return "memory limit"
                if limit is not None and int(self.tree.counts[TRIALS]) >= limit:
                    return "iteration limit"
                if self._batch(limit):
                    return "converged" if self.widest_gap <= self.demand.gap else "rounding limit"
        except TimeIsUp:
            return "time limit"
        except KeyboardInterrupt:
            return "interrupted"

    @property
    def goal(self) -> float:
        """The gap to reach in the tree: with rounding and merging, what was asked for, if it can be had."""
        allowance = self.widening + self.problem.slack
        return max(self.demand.gap - allowance, allowance)

    @property
    def widest_gap(self) -> float:
        """max over the roots of upper - lower."""
        return float((self.root_upper - self.root_lower).max(initial=0.0))

    def _batch(self, limit: int | None) -> bool:
        """Trials up to the next multiple of the batch, in slices of about 0.1 s; whether done."""
        style, problem = self.style, self.problem
        number = int(self.tree.counts[TRIALS]) // style.batch
        sarsop = style.sarsop != (style.turns and number % 2 == 1)
        target = (number + 1) * style.batch
        if limit is not None:
            target = min(target, limit)
        while int(self.tree.counts[TRIALS]) < target:
            started, trials = time.perf_counter(), target - int(self.tree.counts[TRIALS])
            code = search(
                problem.arrays, self.tree, self.trial, self.roots, problem.discount, self.goal,
                style.share, style.fine, sarsop, min(self.slice, trials), self.next_tidy, self.least,
            )  # fmt: skip
            elapsed = time.perf_counter() - started
            self.slice = self.slice * 2 if elapsed < 0.05 else max(1, self.slice // 2)
            self._make_room()
            if code == ALL_CLOSE:
                self.note()
                return True
            if code == TO_TIDY:
                self._raise_and_tidy()
            if code == NO_ROOM:
                self.tree = grown(self.tree, self.least * 64)
            self.demand.poll()
        self._sweep()
        self.note()
        return False

    def _make_room(self) -> None:
        self.tree = grown(self.tree, self.least * 4)
        buckets = len(self.tree.bucket)
        if self.tree.counts[NODES] > 2 * buckets:
            self.tree = self.tree._replace(bucket=np.full(8 * buckets, -1, dtype=np.int64))
            tree_beliefs.rehash(self.tree)

    def _raise_and_tidy(self) -> None:
        tree, problem = self.tree, self.problem
        gain = 1e-3 * self.demand.gap
        for _ in range(self.style.raising_rounds):
            opened = np.flatnonzero(tree.node[: tree.counts[NODES], FIRST_CHOICE] >= 0)
            self.generator.shuffle(opened)
            before = tree.bound[:, LOWER].copy()
            for part in np.array_split(opened, max(1, len(opened) // 200)):
                tree = self.tree = grown(self.tree, for_vectors(self.least) * len(part))
                tree_bounds.raise_lower(
                    problem.arrays, tree, part, before, problem.discount, gain, self.least
                )
                self.demand.poll()
        if self.tree.counts[VECTORS] >= self.next_evaluation and len(self.tree.dense) > NARROW:
            self._evaluate()
            tree = self.tree
        used = np.zeros(max(len(tree.bound), len(tree.vector)), dtype=np.int64)
        tree_bounds.tidy(tree, used)
        self.next_tidy = int(tree.counts[VECTORS] * self.style.tidy_factor) + 50

    def _evaluate(self) -> None:
        """Add what the controllers made of the present vectors earn."""
        if self.evaluator is None:
            self.evaluator = Evaluator(self.problem, self.demand, self.above)
        found = self.evaluator.evaluated(self.tree, self.widest_gap)
        if found.controllers.complete:
            self.tree = with_controllers(self.tree, self.least, found.controllers, found.vectors)
        self.next_evaluation = int(self.tree.counts[VECTORS] * self.style.evaluation_factor)

    def _sweep(self) -> None:
        done = int(self.tree.counts[TRIALS])
        evaluate = done - self.evaluated >= self.style.evaluate_every
        if evaluate:
            self.evaluated = done
        threshold = 1e-3 * self.demand.gap
        self.tree = grown(self.tree, for_points(int(self.tree.counts[NODES])))
        tree_bounds.sweep(self.problem.arrays, self.tree, self.problem.discount, threshold, evaluate)

    # -- the result ----------------------------------------------------------------------------

    def solution(self, status: Status) -> POMDPSolution:
        """What has been found."""
        for node in self.roots.tolist():
            tree_bounds.refresh_lower(self.tree, node)
            tree_bounds.refresh_upper(self.tree, node)
        self.note(tell=False)
        last, policy = self.history[-1], self._policy()
        widest = self.widest_gap
        text = f"the optimum at the start lies in [lower, upper], {last.upper - last.lower:.3g} wide, "
        text += "and the policy earns at least lower; rounding included"
        if len(self.roots) > sum(root.weight > 0 for root in self.problem.roots):
            text += f"; at every root belief at most {widest:.3g} wide"
        return POMDPSolution(
            lower=last.lower,
            upper=last.upper,
            value=last.lower,
            policy=policy,
            root_lower=self.root_lower,
            root_upper=self.root_upper,
            status="converged" if widest <= self.demand.gap else status,
            guarantee=Guarantee("bounds", text),
            method=self.style.name,
            vectors=policy.count,
            iterations=int(self.tree.counts[TRIALS]),
            seconds=time.perf_counter() - self.began,
            history=tuple(self.history),
            note=f"{int(self.tree.counts[NODES])} beliefs, {int(self.tree.counts[LOG])} updates of points",
        )

    def _links(self, m: int) -> IntArray:
        """The vectors that vector m continues with."""
        link = int(self.tree.vector[m, FIRST_LINK])
        if link < 0:
            return np.zeros(0, dtype=np.int64)
        return self.tree.links[
            link : link + len(self.problem.branch_range(int(self.tree.vector[m, OPTION])))
        ]

    def _policy(self) -> AlphaVectors:
        """The vectors in the lists and those at the roots, closed under links."""
        tree, problem = self.tree, self.problem
        keep = np.zeros(int(tree.counts[VECTORS]), dtype=np.bool_)
        for newest in tree.head[:, NEWEST_VECTOR].tolist():
            while newest >= 0:
                keep[newest] = True
                newest = int(tree.vector[newest, OLDER])
        keep[tree.node[self.roots, BEST]] = True
        layer = np.flatnonzero(keep)
        while len(layer):
            followers = np.unique(
                np.concatenate([np.zeros(0, dtype=np.int64), *map(self._links, layer.tolist())])
            )
            layer = followers[~keep[followers]]
            keep[layer] = True
        vectors: list[FloatArray] = []
        actions: list[IntArray] = []
        for y in range(problem.classes):
            mine = np.flatnonzero(keep & (tree.vector[: len(keep), OF_CLASS] == y))
            places = tree.vector[mine, AT][:, None] + np.arange(problem.size(y))[None, :]
            vectors.append(tree.number[places])
            actions.append(problem.option_action[tree.vector[mine, OPTION]])
        return problem.policy(vectors, actions, "lower")


def _depth(run: Search) -> int:
    """Steps after which even the widest gap weighs less than the gap that is asked for."""
    discount = run.problem.discount
    if discount == 0:
        return 1
    ratio = 2 * run.problem.value_span / run.demand.gap
    steps = math.log(max(ratio, 2.0)) / -math.log(discount)
    return min(MAXIMUM_DEPTH, math.ceil(steps) + 1)


def run_search(
    problem: Problem, demand: Demand, style: Style, memory_limit: int = MEMORY_LIMIT
) -> POMDPSolution:
    """Bounds and a policy by trials; `demand.iterations` counts trials, `memory_limit` bytes.

    Raises:
        ModelError: no discount below 1, or a gap that is not positive.
    """
    if not problem.discount < 1:
        raise ModelError(
            f"{style.name} needs a discount below 1, not {problem.discount:g}; give --discount, or a "
            "horizon to the exact solver"
        )
    if not demand.gap > 0:
        raise ModelError(f"the gap is {demand.gap}: it must be positive; 1e-6 is a common choice")
    if problem.classes == 0:
        return nothing_to_gain(problem, style.name)
    run = begun(problem, demand, style, memory_limit)
    return run.solution(run.run())


def begun(problem: Problem, demand: Demand, style: Style, memory_limit: int) -> Search:
    """A search with its starting bounds; after Ctrl-C with simpler ones, and it ends at once."""
    try:
        return Search(problem, demand, style, memory_limit)
    except KeyboardInterrupt:
        quiet = replace(demand, progress=None)
        run = Search(problem, replace(quiet, deadline=0.0), style, memory_limit)
        run.demand, run.stopped = quiet, True
        return run


def nothing_to_gain(problem: Problem, method: str) -> POMDPSolution:
    """The solution where no belief is worth anything but 0."""
    none = np.zeros(len(problem.roots))
    return POMDPSolution(
        0.0, 0.0, 0.0, problem.policy([], [], "exact"), none, none, "converged",
        Guarantee("exact", "every state is worth 0 under every policy"), method, 0, 0, 0.0,
        (Bounds(0.0, 0.0, 0.0),),
    )  # fmt: skip
