"""Certified bounds on what a policy over beliefs earns: the beliefs that it meets are followed, not drawn.

A deterministic policy pi(b) meets from b0 a graph of beliefs: belief b leads by a = pi(b) with the chance

    p = sum over t of (b K_a^o)(t),  t as is seen and not terminal,      to the belief  b K_a^o / p

for each o and each thing seen of the state.  Ended episodes earn nothing more.  The values of the graph's
beliefs solve  V(b) = b . R_a + gamma sum p V(b'):  a Markov chain.  Beliefs are followed in the order of

    gamma^t * probability * (high(b) - low(b)),

and those that are not followed are worth between low(b) and high(b), what *any* policy earns: high is the
fast informed bound (`fast_informed`) and low the same of the negated rewards.  Where no belief is left the
value is exact but for rounding; so it is where beliefs repeat, as equal ones are one.

*Rounding, and beliefs that are one.*  Beliefs within `MERGE` in L1 distance and over the same states count
as one, at which the policy is asked once.  Let d be the largest such distance plus what rounding may do to
a belief in one step.  The policy that the graph describes earns from a node n the linear function
alpha_n . b, whose entries differ by at most s = (R_max - R_min) / (1 - gamma), 0 among the rewards.  So
the values computed for the nodes are off by at most E with

    E <= e + gamma (d s / 2 + E),      E <= (e + gamma d s / 2) / (1 - gamma),

e being the error of b . R_a, of p and of the sums (Higham 2002, section 3.1): bounds are moved outwards by
that.  Where rounding tips a tie of the policy, it is the policy as it was asked here that is certified.
"""

from __future__ import annotations

import heapq
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeAlias

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import ModelError
from factored_polca.solvers.bounds import UNIT
from factored_polca.solvers.choose import solve_mdp
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand

MERGE: Final = 1e-10
"""Beliefs over the same states within this L1 distance count as equal."""

DIGITS: Final = 12
"""Decimals by which equal beliefs are found."""

BELIEFS: Final = 2_500
"""Beliefs that are followed at most, unless another number is given."""

ENTRIES: Final = 1 << 22
"""Entries of the beliefs that the policy is asked for at once."""

AT_ONCE: Final = 256
"""Beliefs that are followed at once."""

CLOSE: Final = 1e-9
"""Share of the span of all values at which following more beliefs ends."""

Choose: TypeAlias = Callable[[FloatArray], IntArray]
"""The numbers of actions [n] at beliefs [n, s]; -1 for none."""


@dataclass(frozen=True)
class PolicyBounds:
    """lower <= what the policy earns from b0 <= upper, rounding included.

    `followed` beliefs were expanded, `left` were not: the process ends there within what any policy earns.
    `merged` is the largest distance of beliefs that counted as one.
    """

    lower: float
    upper: float
    followed: int
    left: int
    merged: float
    seconds: float

    @property
    def closed(self) -> bool:
        """Whether all beliefs that the policy meets were followed."""
        return self.left == 0


def bound_policy(
    pomdp: ArrayPOMDP,
    choose: Choose,
    *,
    beliefs: int = BELIEFS,
    deadline: float | None = None,
    floor: Callable[[FloatArray], FloatArray] | None = None,
) -> PolicyBounds:
    """Bounds on the value of a policy at b0, following up to `beliefs` beliefs, until `deadline`.

    `floor` says what the policy itself earns at least [n] at beliefs [n, s], where something is known.

    Raises:
        ModelError: discount 1, or the policy has no action at a belief that it meets.
        KeyboardInterrupt: Ctrl-C.
    """
    began = time.perf_counter()
    if not pomdp.discount < 1:
        raise ModelError("bounds of a policy over beliefs need a discount below 1")
    graph = _Graph(pomdp, choose, Demand(deadline=deadline), floor)
    graph.start()
    graph.follow(beliefs)
    lower, upper = graph.value(-1), graph.value(1)
    seconds = time.perf_counter() - began
    left = len(graph.states) - len(graph.opened)
    return PolicyBounds(lower, upper, len(graph.opened), left, graph.merged, seconds)


class _Graph:
    """The beliefs met so far (a working state); lists are by the number of a belief."""

    def __init__(
        self,
        pomdp: ArrayPOMDP,
        choose: Choose,
        demand: Demand,
        floor: Callable[[FloatArray], FloatArray] | None,
    ) -> None:
        self.pomdp, self.choose, self.demand = pomdp, choose, demand
        self.live = ~pomdp.terminal
        self.states: list[IntArray] = []
        self.shares: list[FloatArray] = []
        self.bounds: list[tuple[float, float]] = []
        self.weight: list[float] = []  # discounted probability by which it was met so far
        self.opened: dict[int, int] = {}  # belief -> its row below
        self.gain: list[float] = []
        self.children: list[list[tuple[int, float]]] = []
        self.index: dict[tuple[bytes, bytes], int] = {}
        self.queue: list[tuple[float, int]] = []
        self.roots: list[tuple[int, float]] = []
        self.merged, self.waiting = 0.0, 0.0
        most = _best(pomdp, demand)
        least = _best(replace(pomdp, rewards=-pomdp.rewards), demand)

        def low(beliefs: FloatArray) -> FloatArray:
            known = -least.values(beliefs)
            return known if floor is None else np.maximum(known, floor(beliefs))

        self.low = low
        self.high: Callable[[FloatArray], FloatArray] = most.values
        rewards = pomdp.rewards
        self.span = float(rewards.max(initial=0.0) - rewards.min(initial=0.0)) / (1 - pomdp.discount)

    def start(self) -> None:
        """The parts of b0, by what is seen, that have not ended."""
        initial = csr_array(self.pomdp.initial[None, :])
        self.roots = [(child, chance) for _, child, chance in self.met(self.parts(initial), [1.0])]

    def follow(self, limit: int) -> None:
        """Follow the beliefs that matter most, until few matter."""
        widest = max(1, ENTRIES // self.pomdp.states)
        while self.queue and len(self.opened) < limit and self.waiting > CLOSE * self.span:
            if self.demand.seconds_left == 0:
                return
            self.demand.poll()
            batch: list[int] = []
            most = min(AT_ONCE, widest, limit - len(self.opened), 1 + len(self.opened) // 4)
            while self.queue and len(batch) < most:
                _, number = heapq.heappop(self.queue)
                if number not in self.opened:
                    self.opened[number] = len(self.opened)
                    self.waiting -= self.matters(number)
                    batch.append(number)
            self.open(batch)

    def open(self, batch: Sequence[int]) -> None:
        """Ask the policy at some beliefs, and meet what comes after."""
        rows = self.rows(batch)
        dense = rows.toarray()
        actions = self.choose(dense)
        if (actions < 0).any():
            raise ModelError("the policy has no action at a belief of an episode that goes on")
        self.gain += (dense * self.pomdp.rewards[actions]).sum(axis=1).tolist()
        self.children += [[] for _ in batch]
        for action in np.unique(actions).tolist():
            mine = np.flatnonzero(actions == action)
            weights = [self.weight[batch[i]] * self.pomdp.discount for i in mine.tolist()]
            parts = [p for m in self.pomdp.kernel[action] for p in self.parts(csr_array(rows[mine] @ m))]
            for place, child, chance in self.met(parts, weights):
                self.children[self.opened[batch[mine[place]]]].append((child, chance))

    def parts(self, rows: csr_array) -> Iterator[tuple[int, IntArray, FloatArray]]:
        """What goes on of weights [n, s], by what is seen: the row, states in order, their weights."""
        row = np.repeat(np.arange(rows.shape[0]), np.diff(rows.indptr))
        kept = self.live[rows.indices] & (rows.data > 0)
        row, state, data = row[kept], rows.indices[kept].astype(np.int64), rows.data[kept]
        seen = self.pomdp.observed[state]
        order = np.lexsort((state, seen, row))
        row, state, data, seen = row[order], state[order], data[order], seen[order]
        if not len(row):
            return
        cuts = np.flatnonzero((np.diff(row) != 0) | (np.diff(seen) != 0)) + 1
        for start, end in zip([0, *cuts.tolist()], [*cuts.tolist(), len(row)], strict=True):
            yield int(row[start]), state[start:end], data[start:end]

    def met(
        self, parts: Iterator[tuple[int, IntArray, FloatArray]] | list[tuple[int, IntArray, FloatArray]],
        weights: Sequence[float],
    ) -> list[tuple[int, int, float]]:  # fmt: skip
        """The belief that each part is, made where it is new: (row, belief, chance).

        `weights` [row] is the discounted probability of what the parts come from.
        """
        found, first = [], len(self.states)
        for place, states, data in parts:
            chance = float(data.sum())
            number = self.number(states, data / chance)
            found.append((place, number, chance))
        fresh = range(first, len(self.states))
        step = max(1, ENTRIES // self.pomdp.states)
        for begin in range(first, len(self.states), step):
            dense = self.rows(fresh[begin - first : begin - first + step]).toarray()
            self.bounds += zip(self.low(dense).tolist(), self.high(dense).tolist(), strict=True)
        for place, number, chance in found:
            self.add(number, weights[place] * chance)
        return found

    def number(self, states: IntArray, shares: FloatArray) -> int:
        """The number of a belief, a new one unless it counts as an old one."""
        key = states.tobytes(), np.round(shares, DIGITS).tobytes()
        known = self.index.get(key)
        if known is not None:
            distance = float(np.abs(self.shares[known] - shares).sum())
            if distance <= MERGE:
                self.merged = max(self.merged, distance)
                return known
        self.states.append(states)
        self.shares.append(shares)
        self.weight.append(0.0)
        self.index[key] = len(self.states) - 1
        return len(self.states) - 1

    def add(self, number: int, weight: float) -> None:
        """A belief is met with a discounted probability."""
        self.weight[number] += weight
        if number not in self.opened:
            low, high = self.bounds[number]
            self.waiting += weight * (high - low)
            heapq.heappush(self.queue, (-self.matters(number), number))

    def matters(self, number: int) -> float:
        """What following a belief may narrow the bounds by, at most."""
        low, high = self.bounds[number]
        return self.weight[number] * (high - low)

    def rows(self, numbers: Sequence[int]) -> csr_array:
        """Beliefs as rows [n, s]."""
        ends = np.cumsum([0, *(len(self.states[n]) for n in numbers)])
        columns = np.concatenate([self.states[n] for n in numbers])
        data = np.concatenate([self.shares[n] for n in numbers])
        return csr_array((data, columns, ends), shape=(len(numbers), self.pomdp.states))

    def value(self, side: int) -> float:
        """A bound on the policy's value at b0: from below for -1, from above for 1."""
        if not self.roots:  # all has ended
            return 0.0
        bound = [low if side < 0 else high for low, high in self.bounds]
        count, discount = len(self.opened), self.pomdp.discount
        if count:
            gains = np.array(self.gain)
            entries: list[tuple[int, int, float]] = []
            for row, children in enumerate(self.children):
                for child, chance in children:
                    if child in self.opened:
                        entries.append((row, self.opened[child], chance))
                    else:
                        gains[row] += discount * chance * bound[child]
            known = solve_mdp(_chain(gains, entries, discount), deadline=self.demand.deadline)
            if known.status == "interrupted":
                raise KeyboardInterrupt
            solved = known.lower if side < 0 else known.upper
            for number, row in self.opened.items():
                bound[number] = float(solved[row])
        total = sum(chance * bound[number] for number, chance in self.roots)
        return total + side * self.error()

    def error(self) -> float:
        """E of the module's docstring."""
        pomdp = self.pomdp
        live = np.flatnonzero(self.live)
        sums = [np.asarray(sum(m.sum(axis=1) for m in row))[live] for row in pomdp.kernel]
        miss = max((float(np.abs(part - 1).max(initial=0.0)) for part in sums), default=0.0)
        branches = max((len(row) for row in self.children), default=0)
        step = (3 * pomdp.states + branches + 64) * UNIT * 1.01 + miss
        largest = float(np.abs(pomdp.rewards).max(initial=0.0))
        size = largest / (1 - pomdp.discount)
        wrong = step * (largest + size) + pomdp.discount * (self.merged + 2 * step) * self.span / 2
        return wrong / (1 - pomdp.discount) + 4 * UNIT * size


def _best(pomdp: ArrayPOMDP, demand: Demand) -> AlphaVectors:
    """Vectors whose maximum no policy exceeds."""
    found = solve_pomdp(pomdp, "fib", demand=demand)
    if found.status == "interrupted":
        raise KeyboardInterrupt
    assert isinstance(found.policy, AlphaVectors)
    return found.policy


def _chain(gains: FloatArray, entries: Sequence[tuple[int, int, float]], discount: float) -> ArrayMDP:
    """A Markov chain over the followed beliefs and one state more, where what is left ends."""
    count = len(gains)
    row = np.array([entry[0] for entry in entries], dtype=np.int64)
    column = np.array([entry[1] for entry in entries], dtype=np.int64)
    chance = np.array([entry[2] for entry in entries])
    rest = np.maximum(1 - np.bincount(row, chance, count), 0.0)
    ending = np.flatnonzero(rest > 0)
    shape = (count + 1, count + 1)
    matrix = csr_array(
        (
            np.concatenate([chance, rest[ending]]),
            (np.concatenate([row, ending]), np.concatenate([column, np.full(len(ending), count)])),
        ),
        shape=shape,
    )
    terminal = np.arange(count + 1) == count
    rewards = np.append(gains, 0.0)[None, :]
    return ArrayMDP(("policy",), (matrix,), rewards, ~terminal[None, :], terminal, discount)
