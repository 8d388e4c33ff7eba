"""What a set of alpha-vectors from elsewhere earns at least, proved by linear algebra.

Vectors that another program computed need not be lower bounds: they may be rounded, printed with six
digits, or come from a horizon.  So they are used as a *policy* only.  From each root the beliefs that this
policy meets are unfolded, up to `NODES`; each belief becomes a controller that takes the action of the best
vector there and hands over to the controllers of the beliefs that follow (beyond the limit, to one with the
same vector).  What controllers earn is solved for and moved down until it certainly is a lower bound
(`factored_polca.solvers.controllers`); a few times each hands over to the best ones instead.

The vectors V_n of all controllers make the policy that is returned.  It earns max_n V_n(b) at least: its
first action is that of the best n, after which max_m V_m is at least the value of n's successor.

Where a problem is small, the proposed vectors V prove an upper bound too, by one exact backup H:

    V* <= H V + gamma / (1 - gamma) max over b of ((H V)(b) - V(b))        (Puterman 1994, Theorem 6.3.3).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.bellman_residual import excess
from factored_polca.solvers.controllers import UNIT, Controllers
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.exact_backup import backup
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand

NODES: Final = 1000
"""Beliefs that become controllers, at most (and one more for each vector met beyond)."""
ROUNDS: Final = 12
SWEEPS: Final = 20_000
FEW_STATES: Final = 12
FEW_VECTORS: Final = 100
DIGITS: Final = 9
"""Beliefs that agree to so many digits are one."""


@dataclass
class _Unfolding:
    """The working state: controllers [n] with the belief each was made for."""

    problem: Problem  # not merged: option = first option of the class + action
    vectors: list[FloatArray]  # [y] [n, n_y]
    actions: list[IntArray]  # [y] [n]
    classes: list[int] = field(default_factory=list)
    options: list[int] = field(default_factory=list)
    beliefs: list[FloatArray] = field(default_factory=list)
    promised: list[FloatArray] = field(default_factory=list)  # the vector that was best
    numbers: dict[tuple[int, bytes], int] = field(default_factory=dict)
    of_vector: dict[tuple[int, int], int] = field(default_factory=dict)

    def node(self, y: int, belief: FloatArray) -> int:
        """The controller for a belief over class y, a new one where there is room."""
        key = (y, np.round(belief, DIGITS).tobytes())
        if key in self.numbers:
            return self.numbers[key]
        best = int((self.vectors[y] @ belief).argmax())
        if len(self.options) >= NODES and (y, best) in self.of_vector:
            return self.of_vector[y, best]
        number = len(self.options)
        self.numbers[key] = number
        self.of_vector.setdefault((y, best), number)
        self.classes.append(y)
        self.options.append(int(self.problem.arrays.first_option[y]) + int(self.actions[y][best]))
        self.beliefs.append(belief)
        self.promised.append(self.vectors[y][best])
        return number


def certified(problem: Problem, proposed: AlphaVectors, demand: Demand) -> tuple[AlphaVectors, FloatArray]:
    """A policy made of the proposed one, and what it certainly earns at each root [root].

    `problem` is prepared without merging.  In a class for which `proposed` has no vectors the first action
    is taken.
    """
    state = _Unfolding(problem, *_by_class(problem, proposed))
    after = _unfold(state)
    controllers = _linked(state, after, None)
    goal = max(demand.gap, 1e-12) * (1 - problem.discount) / 10
    span = problem.value_span
    vectors = np.clip(np.concatenate([np.zeros(0), *state.promised]), -span, span)  # where sweeps start
    best_vectors, best_values, best = vectors, np.full(len(problem.roots), -np.inf), controllers
    for _ in range(ROUNDS):
        vectors = controllers.from_below(controllers.evaluated(vectors, SWEEPS, goal, demand))
        values, _ = controllers.best(vectors)
        gained = values - best_values
        if gained.max(initial=0.0) > 0:
            best_vectors, best_values, best = vectors, values, controllers
        if gained.max(initial=0.0) <= demand.gap / 100 or demand.seconds_left <= 0:
            break
        controllers = _linked(state, after, vectors, controllers)
    parts = best.by_class(best_vectors)
    actions = [problem.option_action[best.options[numbers]] for numbers, _ in parts]
    return problem.policy([block for _, block in parts], actions, "lower"), best_values


def upper_by_backup(problem: Problem, proposed: AlphaVectors, demand: Demand) -> FloatArray | None:
    """An upper bound at each root [root] by one exact backup; None where that is too much work.

    `problem` is prepared without merging.
    """
    sets, _ = _by_class(problem, proposed)
    largest = max(problem.size(y) for y in range(problem.classes))
    if largest > FEW_STATES or max(len(vectors) for vectors in sets) > FEW_VECTORS:
        return None
    try:
        found = backup(problem, sets, poll=demand.poll)
        eps = 0.0
        for before, part in zip(sets, found.classes, strict=True):
            eps = max(eps, excess(part.vectors, before, part.witnesses, eps, demand.poll))
    except TimeIsUp:
        return None
    scale = max(float(np.abs(vectors).max(initial=0.0)) for vectors in (*sets, *found.sets))
    delta = found.error + 64 * largest * UNIT * max(scale, problem.value_span * (1 - problem.discount))
    ratio = problem.discount * (1 + 1e-9)  # rows sum to 1 within 1e-9
    if not ratio < 1:
        return None
    best = np.array([float((found.classes[r.y].vectors @ r.belief).max()) for r in problem.roots])
    upper: FloatArray = best + delta + ratio * (eps + delta) / (1 - ratio)
    return upper


def _by_class(problem: Problem, proposed: AlphaVectors) -> tuple[list[FloatArray], list[IntArray]]:
    """The proposed vectors [n, n_y] and actions [n] for each class of the problem."""
    bounds = problem.arrays.offset
    vectors, actions = [], []
    for y in range(problem.classes):
        mine = problem.states[bounds[y] : bounds[y + 1]]
        part = next((p for p in proposed.sets if np.isin(mine, p.states).any()), None)
        if part is None:
            vectors.append(np.zeros((1, len(mine))))
            actions.append(np.zeros(1, dtype=np.int64))
            continue
        whole = np.zeros((len(part.vectors), proposed.states))
        whole[:, part.states] = part.vectors
        vectors.append(np.ascontiguousarray(whole[:, mine]))
        actions.append(np.asarray(part.actions, dtype=np.int64))
    return vectors, actions


def _unfold(state: _Unfolding) -> list[list[tuple[int, FloatArray | None]]]:
    """For each controller and branch of its option the next controller, and the belief there."""
    problem = state.problem
    for root in problem.roots:
        state.node(root.y, root.belief)
    for y in range(problem.classes):  # so that no branch is without a successor
        state.node(y, np.full(problem.size(y), 1 / problem.size(y)))
    result: list[list[tuple[int, FloatArray | None]]] = []
    queue, placed = deque(range(len(state.options))), len(state.options)
    first = {y: n for n, y in reversed(list(enumerate(state.classes)))}
    while queue:
        number = queue.popleft()
        row: list[tuple[int, FloatArray | None]] = []
        for k in problem.branch_range(state.options[number]):
            mass = np.asarray(state.beliefs[number] @ problem.matrices[k], dtype=np.float64)
            total, target = float(mass.sum()), int(problem.arrays.branch_target[k])
            if total <= 1e-14:
                row.append((first[target], None))
            else:
                row.append((state.node(target, mass / total), mass / total))
        result.append(row)
        queue.extend(range(placed, len(state.options)))
        placed = len(state.options)
    return result


def _linked(
    state: _Unfolding,
    after: list[list[tuple[int, FloatArray | None]]],
    vectors: FloatArray | None,
    known: Controllers | None = None,
) -> Controllers:
    """The controllers; given their `vectors` [x], each hands over to the best at the next belief."""
    width = max((len(row) for row in after), default=0)
    successors = np.full((len(after), width), -1, dtype=np.int64)
    parts = None if vectors is None or known is None else known.by_class(vectors)
    for number, row in enumerate(after):
        option = state.options[number]
        for place, (target, belief) in enumerate(row):
            if parts is not None and belief is not None:
                y = state.problem.arrays.branch_target[state.problem.branch_range(option)[place]]
                numbers, block = parts[int(y)]
                target = int(numbers[(block @ belief).argmax()])
            successors[number, place] = target
    return Controllers(state.problem, np.array(state.options, dtype=np.int64), successors)
