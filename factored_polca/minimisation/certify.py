"""Certify a partition: a second opinion that shares no random number with the minimiser.

A partition is *stable* and *agrees on rewards* if any two states x, y of one block have the same
terminal flag and applicable choices, and for each applicable choice c

    R_c(x) = R_c(y),    T_c(x, k) = T_c(y, k) for every block k,    T_c(x, k) = sum_{x' in k} T_c(x, x')

(a stochastic bisimulation: Dean & Givan 1997; Givan, Dean & Greig 2003).  That makes its quotient
exact.  That it is the *coarsest* such partition is another question, which is not asked here.

Where rows look up only, all rows T_c(x, .) modulo a fixed prime are made at once, as wholes
(`factored_polca.minimisation.whole_rows`), and what is checked is that the number of the row is constant on
every block.  Elsewhere each block's indicator is regressed through each choice.  A function is
constant on every block exactly where it equals the partition relabelled by the function's values at
the representatives, and equality of two diagrams is equality of two nodes.

How many primes: let p, q be the primitives that c stands for at x and y, D_p the product over
features of the least common denominators of their rows, so T_p(x, k) = n / D_p with 0 <= n <= D_p, and
L_c the least common multiple of D_p over all primitives of c.  Then

    L_c (T_c(x, k) - T_c(y, k))  is an integer, of absolute value at most L_c;

modulo primes that divide no denominator and whose product exceeds 2 L_c it is 0 modulo all of them only
if it is 0.  Likewise for rewards, with L the least common multiple of the denominators of all terms
and 2 L max_p sum_terms max |value| as the bound.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from math import lcm

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    MERSENNE_61,
    Aborted,
    Diagram,
    Field,
    MemoryLimit,
    choose,
    evaluate_states,
    is_prime,
    leaves,
    relabel,
    states_for_leaves,
)
from factored_polca.minimisation.criterion import (
    Choice,
    DecisionProcess,
    ProcessView,
    common_denominator,
    largest_reward,
    reward_denominator,
    row_denominator,
)
from factored_polca.minimisation.indicators import Indicators
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.push import make_plan, push_exact, row_table, rows_at
from factored_polca.minimisation.quotient import exact_rewards, primitives_at
from factored_polca.minimisation.whole_rows import WholeRows
from factored_polca.models import LimitReached, ModelError
from factored_polca.symbolic import NumericView

Int32Array = npt.NDArray[np.int32]

Progress = Callable[[int, int], None]
"""Called after each choice with the number of checks made and the number there will be."""


@dataclass(frozen=True)
class Certificate:
    """What was checked of a partition and what was found.

    `ok` says that the partition is stable and agrees on rewards, so that its quotient is exact; it
    does not say that the partition is the coarsest such one.  `checks` counts functions shown to be
    constant on every block (or not); `bits` is the size of the largest integer that the `primes`
    had to tell from 0.  Each failure names a block, what differs, and two states of the block.
    """

    ok: bool
    blocks: int
    checks: int
    primes: tuple[int, ...]
    bits: int
    failures: tuple[str, ...]
    seconds: float

    def __str__(self) -> str:
        found = "stable, rewards agree" if self.ok else f"{len(self.failures)} failures"
        text = f"{self.blocks:,} blocks, {self.checks:,} checks modulo {len(self.primes)} primes: {found}"
        return "\n".join([f"{text} (that no coarser partition would do is not checked)", *self.failures])


def certify(
    process: DecisionProcess,
    partition: Partition,
    *,
    failure_limit: int = 10,
    progress: Progress | None = None,
) -> Certificate:
    """Check that `partition` is stable under `process` and separates different rewards.

    States outside a restriction of the process are ignored.  Where rows look down the number of
    regressions is blocks times primitives times primes, divided by the blocks of a pack.

    Args:
        failure_limit: stop after so many failures.

    Raises:
        LimitReached: memory or time; `partial` is a certificate of the checks so far, not `ok` (None
            before the first check).
        ValueError: a partition of another model, or a limit below 1.
        ModelError: a partially observed process: observations are not part of these checks.
    """
    if process.partial:
        raise ModelError(
            "certify checks transitions and rewards, not observations: fully observed models only"
        )
    if partition.symbolic.manager is not process.symbolic.manager:
        raise ValueError("the partition belongs to another compiled model than the process")
    if failure_limit < 1:
        raise ValueError(f"failure_limit is {failure_limit}; it must be at least 1")
    try:
        check = _Check(process, partition, failure_limit, progress)
    except (MemoryLimit, Aborted) as error:
        text = f"certification stopped before the first check: {error}"
        raise LimitReached(text, "certification") from None
    try:
        for failure in check.run():
            check.failures.append(failure)
            if len(check.failures) == failure_limit:
                break
    except (MemoryLimit, Aborted) as error:
        raise LimitReached(
            f"certification stopped after {check.checks:,} of {check.planned:,} checks: {error}",
            "certification",
            check.certificate(complete=False),
        ) from None
    return check.certificate(complete=True)


class _Regressed:
    """Indicators of packs of blocks, regressed through one primitive after the other when asked for."""

    def __init__(
        self, numbers: NumericView, labels: Diagram, packs: list[list[int]], base: int, field: Field
    ) -> None:
        self.numbers, self.labels, self.packs, self.base, self.field = numbers, labels, packs, base, field
        self.indicators: Indicators | None = None
        self.parts: dict[int, list[Diagram]] = {}

    def of_choice(self, view: ProcessView, choice: Choice, k: int) -> Diagram:
        """The probability, as a function of the state, that the choice enters the blocks of pack k."""
        if self.indicators is None:
            self.indicators = Indicators(self.labels, self.packs, self.base, self.field)
        for primitive in choice.primitives:
            if primitive not in self.parts:
                self.parts[primitive] = self.indicators.regress(self.numbers, primitive)
        return view.select(choice, {p: self.parts[p][k] for p in choice.primitives})

    def keep(self, primitives: set[int]) -> None:
        """Forget all others."""
        self.parts = {p: parts for p, parts in self.parts.items() if p in primitives}


class _Check:
    """The working state of one certification."""

    def __init__(
        self, process: DecisionProcess, partition: Partition, limit: int, progress: Progress | None
    ) -> None:
        self.process, self.symbolic = process, process.symbolic
        self.manager = process.symbolic.manager
        self.limit, self.progress = limit, progress
        self.partition = partition
        self.outside = partition.blocks
        self.start = time.perf_counter()
        self.failures: list[str] = []
        self.checks = 0
        self.inside = self.manager.constant(1) if process.reachable is None else process.reachable
        self.known: set[tuple[int, int]] = set()  # choices and blocks (-1: reward) found to fail
        self.labels = partition.diagram
        if process.reachable is not None:
            self.labels = choose(self.inside, self.labels, self.manager.constant(self.outside))
        self.leaves = [int(leaf) for leaf in leaves(self.labels)]
        self.largest, self.leaf_array = max(self.leaves), np.array(self.leaves)
        self.states = states_for_leaves(self.labels)  # [leaf, level]
        self.row_bits = [_row_bound(process, c).bit_length() + 1 for c in process.choices]  # [choice]
        self.reward_bits = [_reward_bound(process, c).bit_length() + 1 for c in process.choices]
        self.bits = max([*self.row_bits, *self.reward_bits], default=0)
        self.primes = fixed_primes(self.bits, common_denominator(process))
        enough = self.primes_for
        rows = sum(map(enough, self.row_bits)) * len(self.leaves)
        self.planned = 1 + 2 * len(process.choices) + rows + sum(map(enough, self.reward_bits))

    def certificate(self, complete: bool) -> Certificate:
        return Certificate(
            ok=complete and not self.failures,
            blocks=self.partition.blocks,
            checks=self.checks,
            primes=self.primes,
            bits=self.bits,
            failures=tuple(self.failures),
            seconds=time.perf_counter() - self.start,
        )

    def primes_for(self, bits: int) -> int:
        """How many of the primes have a product of more than `bits` bits: each has at least 60."""
        return -(-bits // 60)

    def run(self) -> Iterator[str]:
        """All failures, one by one; masks first, since the later checks read them as sound."""
        before = len(self.failures)
        yield from self.flags()
        if len(self.failures) > before:
            return
        for number, prime in enumerate(self.primes):
            view = ProcessView(self.process, NumericView(self.symbolic, Field(prime)))
            yield from self.rewards(view, number)
            yield from self.transitions(view, number)

    def flags(self) -> Iterator[str]:
        """Every state that counts has a block; terminal flag and masks are constant on blocks."""
        lost = self.labels.equals(self.manager.constant(self.outside)) & self.inside
        if lost != self.manager.constant(0):
            yield f"{self.text(_first_state(lost))} lies in no block"
        found = self.differing(self.process.terminal & self.inside)
        if found is not None:
            yield self.describe(found, "only one of them is terminal")
        for choice in self.process.choices:
            app = choice.app & self.inside
            found = self.differing(app)
            if found is not None:
                yield self.describe(found, f"{choice.name} is applicable at only one of them")
            covered = self.manager.constant(0)
            for primitive in choice.primitives:
                covered = covered | choice.where(primitive)
            bare = app & ~covered
            self.checks += 1
            if bare != self.manager.constant(0):
                where = self.text(_first_state(bare))
                yield f"{choice.name} applies at {where} but stands for no action there"

    def rewards(self, view: ProcessView, number: int) -> Iterator[str]:
        for c, choice in enumerate(self.process.choices):
            if number >= self.primes_for(self.reward_bits[c]):
                continue
            found = self.differing(view.reward(choice))
            if found is not None and (c, -1) not in self.known:
                here, there = (self.exact_reward(choice, state) for state in found)
                self.known.add((c, -1))
                yield self.describe(found, f"the reward of {choice.name} is {here} and {there}")

    def transitions(self, view: ProcessView, number: int) -> Iterator[str]:
        """T_c(x, k) for all choices and blocks modulo one prime, one choice after the other."""
        wanted = [c for c in range(len(self.process.choices)) if number < self.primes_for(self.row_bits[c])]
        field = view.numbers.leaf_type
        assert isinstance(field, Field)
        if not wanted:
            return
        inside = self.outside if self.outside in self.leaves else None
        whole = WholeRows(view.numbers, self.labels, self.largest + 1, inside)
        packs = _Regressed(view.numbers, self.labels, *self.packs(wanted), field)
        single = _Regressed(view.numbers, self.labels, [[leaf] for leaf in self.leaves], 1, field)
        for place, c in enumerate(wanted):
            choice, before = self.process.choices[c], self.checks
            if not self.rows_agree(view, whole, choice) and not self.packs_agree(view, packs, choice):
                self.checks = before
                for k, block in enumerate(self.leaves):
                    self.manager.pause()
                    found = self.differing(single.of_choice(view, choice, k), zero=block == self.outside)
                    if found is not None and (c, block) not in self.known:
                        self.known.add((c, block))
                        yield self.describe_row(choice, block, found)
            self.checks = before + len(self.leaves)
            if self.progress is not None:
                self.progress(self.checks, self.planned)
            later = {p for d in wanted[place + 1 :] for p in self.process.choices[d].primitives}
            packs.keep(later)
            single.keep(later)

    def rows_agree(self, view: ProcessView, whole: WholeRows, choice: Choice) -> bool:
        """Whether the rows of all states of a block are seen to be equal as wholes."""
        rows = whole.of_choice(choice, view.app(choice))
        return rows is not None and not whole.leaves_restriction(rows) and self.differing(rows) is None

    def packs(self, wanted: list[int]) -> tuple[list[list[int]], int]:
        """Blocks that are checked together, and B: as many as go into 60 bits for every choice wanted."""
        bits = max(self.row_bits[c] for c in wanted)
        size = max(1, 60 // bits)
        blocks = [leaf for leaf in self.leaves if leaf != self.outside]
        packs = [blocks[i : i + size] for i in range(0, len(blocks), size)]
        return packs + [[leaf] for leaf in self.leaves if leaf == self.outside], 1 << bits

    def packs_agree(self, view: ProcessView, packs: _Regressed, choice: Choice) -> bool:
        """Whether all packs of blocks are entered alike from all states of a block."""
        for k, pack in enumerate(packs.packs):
            self.manager.pause()
            if self.differing(packs.of_choice(view, choice, k), zero=pack == [self.outside]) is not None:
                return False
        return True

    def differing(self, function: Diagram, zero: bool = False) -> Int32Array | None:
        """Two states [2, level] of one block where `function` differs, or None.

        With `zero` it must be 0 everywhere.  The function is masked: 0 outside the restriction.
        """
        self.checks += 1
        if function.is_constant and not zero:
            return None
        if zero:
            same = function.equals(self.manager.constant(0, function.leaf_type))
        else:
            values = evaluate_states(function, self.states, range(self.manager.leaf_level))
            images = np.zeros(self.largest + 1, dtype=np.uint64)
            images[self.leaf_array] = values
            expected = relabel(self.labels, images, function.leaf_type)
            if expected == function:
                return None
            same = function.equals(expected)
        if same == self.manager.constant(1):
            return None
        state = _first_state(~same)
        return np.stack([self.states[self.leaves.index(self.block_of(state))], state])

    # -- words -----------------------------------------------------------------------------

    def block_of(self, state: Int32Array) -> int:
        """The block of a state [level]."""
        return int(evaluate_states(self.labels, state[None, :], range(self.manager.leaf_level))[0])

    def text(self, state: Int32Array) -> str:
        return self.symbolic.state_text(state.tolist())

    def describe(self, states: Int32Array, what: str) -> str:
        """A failure in words, of two states [2, level]."""
        first, second = (self.text(state) for state in states)
        return f"block {self.block_of(states[0])}: {first} and {second}: {what}"

    def describe_row(self, choice: Choice, block: int, states: Int32Array) -> str:
        here, there = (self.exact_mass(choice, state).get(block, Fraction(0)) for state in states)
        if block == self.outside:
            return (
                f"{choice.name} leaves the restriction at {self.text(states[1])} with probability {there}"
            )
        what = f"the probability that {choice.name} enters block {block} is {here} and {there}"
        return self.describe(states, what)

    def exact_mass(self, choice: Choice, state: Int32Array) -> dict[int, Fraction]:
        """T_c(x, .) in rationals, by pushing mass forward: not the way it was found wrong."""
        values, primitive = self.taken(choice, state)
        if primitive < 0:
            return {}
        rows = self.symbolic.actions[primitive].rows
        plan, table = make_plan(self.symbolic, self.labels, rows), row_table(self.symbolic, rows)
        return push_exact(plan, table, rows_at(self.symbolic, rows, table, plan.slots, values)[0])

    def exact_reward(self, choice: Choice, state: Int32Array) -> Fraction:
        values, primitive = self.taken(choice, state)
        return exact_rewards(self.process, primitive, values)[0] if primitive >= 0 else Fraction(0)

    def taken(self, choice: Choice, state: Int32Array) -> tuple[Int32Array, int]:
        """A state as value numbers [1, feature], and the primitive that `choice` stands for there."""
        values = np.array([self.symbolic.state(state.tolist())], dtype=np.int32)
        return values, int(primitives_at(choice, values, self.symbolic.columns())[0])


def _first_state(condition: Diagram) -> Int32Array:
    """The first state [level] where a condition that holds somewhere is true."""
    state: Int32Array = states_for_leaves(condition)[leaves(condition).index(1)]
    return state


def _row_bound(process: DecisionProcess, choice: Choice) -> int:
    """L_c of the module's docstring."""
    return lcm(*(row_denominator(process, p) for p in choice.primitives))


def _reward_bound(process: DecisionProcess, choice: Choice) -> int:
    """The largest cleared numerator of a difference of two rewards of one choice."""
    common = lcm(*(reward_denominator(process, p) for p in choice.primitives))
    return 2 * int(common * max((largest_reward(process, p) for p in choice.primitives), default=0))


@cache
def _prime_below(bound: int) -> int:
    candidate = bound - 2
    while not is_prime(candidate):
        candidate -= 2
    return candidate


def fixed_primes(bits: int, denominator: int) -> tuple[int, ...]:
    """The largest primes below 2^61 that do not divide `denominator`; their product exceeds 2^bits."""
    primes: list[int] = []
    prime = MERSENNE_61
    while 60 * len(primes) < bits:
        if denominator % prime:
            primes.append(prime)
        prime = _prime_below(prime)
    return tuple(primes)
