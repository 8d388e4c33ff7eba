"""The coarsest stable partition by fingerprints (DESIGN 4; Dean & Givan 1997, Eqs. 3-5 of the paper).

Letters: P partition (state -> block), r_k random field element of block k, V = r o P, f_c = R_c[V]
regression through choice c, masked.

    0. P_0 separates states by terminal flag, applicable choices and a random linear form of the rewards.
    1. one pass: for each choice c, V = r o P, f_c = R_c[V]; P becomes the distinct pairs (P, f_c).
    2. a pass without a split ends the refinement;
    3. a confirming pass repeats the rewards of 0, and 1, with fresh draws and another, random, prime; a
       split there sends the refinement on with that prime.

No confirming pass is needed where no two states are left that could differ: such a partition is stable
with certainty (`factored_polca.minimisation.apart`), and the bound, as reported, too large.

Many models are stable after a pass or two, and then step 2 would only do what step 3 does again.  So
the first `EARLY` passes after the first one are confirming passes: one without a split is the last.

f_c(x) = sum_k r_k T_c(x, k) is a random linear form of the row T_c(x, .).  Equal rows give equal
leaves, since arithmetic is exact: there is no false split, and the result is never finer than the
coarsest stable partition.  Two rows that differ mod p get equal leaves with probability at most 1/p
over r (Schwartz 1980; Zippel 1979).  Rows that differ over the rationals may agree mod one prime; if
the cleared numerator of their difference has B bits, at most B/60 of the 2.7 * 10^16 primes in
[2^60, 2^61) divide it.  A partition that is too coarse has, whatever happened before, a pair of
states in one block with different rows, rewards or masks that is fixed before the confirming draws,
and passes with probability at most

    B/60 / 2.7 * 10^16 + (3 + J) / 2^60,   J observation channels,

which is reported, raised to the number of confirming rounds that passed in a row, times the number of
rounds that might have been the last.

With observations f_c is the sensed regression (`factored_polca.symbolic.sensing`), a random multilinear
form of the joint row over (block, observation): Eq. 13.  Observed features are separated in step 0.

Where actions are interchangeable (`factored_polca.minimisation.interchangeable`) steps 0 and 1 compare the
multiset of the choices' signatures instead of choice with choice.

Only the first pass of a field regresses V as a whole.  A block that is not split keeps its r_k, and of one
that is one part does; regression is linear, so later passes regress the change of V alone
(`factored_polca.minimisation.pass_kernel`).  With interchangeable choices every pass is a whole one.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    MERSENNE_61,
    Aborted,
    Diagram,
    Field,
    MemoryLimit,
    choose,
    node_count,
    pairs,
    random_prime,
    relabel,
    weighted_sum,
)
from factored_polca.diagrams.operations import leaf_payloads, node
from factored_polca.drawn import Drawn, Framed
from factored_polca.minimisation.apart import all_apart
from factored_polca.minimisation.collision import collision_bound
from factored_polca.minimisation.criterion import DecisionProcess, ProcessView, common_denominator
from factored_polca.minimisation.listed import ListedPartition, ListedRefinement, StateList, state_list
from factored_polca.minimisation.partition import Partition, partition_from
from factored_polca.minimisation.polynomial import Polynomial, refuse_partial
from factored_polca.minimisation.propagation import LARGE, UNLIMITED, Propagation, TooManyBlocks
from factored_polca.minimisation.race import Race
from factored_polca.models import LimitReached
from factored_polca.symbolic import NumericView
from factored_polca.symbolic.descent import Cuts
from factored_polca.symbolic.sensing import SensedRegression, Vanished

EARLY = 3
"""Passes after the first that are confirming passes whatever went before."""


@dataclass(frozen=True)
class Minimisation(Drawn, Framed):
    """A partition and how it was found.

    `rounds` counts passes over the choices, confirming ones included; `collision_bound` bounds the
    probability that the partition is coarser than the coarsest stable one.  `states_listed` is 0, or how
    many states there were on the list where that was quicker than diagrams.
    """

    process: DecisionProcess
    partition: Partition
    rounds: int
    primes: tuple[int, ...]
    collision_bound: float
    seconds: float
    states_listed: int = 0


Progress = Callable[[int, int], None]
"""Called after each pass with the round's number and the blocks so far."""


@dataclass
class _Labels:
    """A partition under way: its diagram, its blocks, and the random element of each."""

    diagram: Diagram
    elements: npt.NDArray[np.uint64]

    @property
    def blocks(self) -> int:
        return len(self.elements)


def minimise(
    process: DecisionProcess,
    *,
    seed: int = 0,
    confirmations: int = 1,
    block_limit: int | None = None,
    progress: Progress | None = None,
    separate: Sequence[Diagram] = (),
    interchangeable: bool = False,
) -> Minimisation:
    """The coarsest stable partition of `process` that separates different rewards.

    Args:
        seed: of the random elements; the partition does not depend on it but with probability
            `collision_bound`.
        confirmations: how many confirming rounds must pass.
        block_limit: stop beyond so many blocks.
        separate: index diagrams over states whose different values must not be merged.
        interchangeable: choices are compared as a multiset, whatever their names.

    Raises:
        ModelError: interchangeable choices of a partially observed process.
        LimitReached: blocks, memory or time; `partial` is the partition so far (None if even numbering
            its blocks takes more memory than there is).
    """
    if interchangeable:
        refuse_partial(process)
    refinement = _Refinement(process, seed, block_limit, progress, separate, interchangeable)
    start = time.perf_counter()
    try:
        refinement.run(confirmations)
    except (MemoryLimit, Aborted) as error:
        raise LimitReached(
            f"minimisation stopped in round {refinement.rounds + 1} at "
            f"{refinement.blocks:,} blocks: {error}",
            "minimisation",
            refinement.partition_so_far(),
        ) from None
    bound = collision_bound(process, interchangeable) ** confirmations * max(1, refinement.attempts)
    seconds = time.perf_counter() - start
    primes = tuple(refinement.primes)
    listed = 0 if refinement.listed is None else refinement.listed.states
    return Minimisation(process, refinement.partition(), refinement.rounds, primes, bound, seconds, listed)


class _Refinement:
    """The working state of one minimisation."""

    def __init__(
        self,
        process: DecisionProcess,
        seed: int,
        block_limit: int | None,
        progress: Progress | None,
        separate: Sequence[Diagram] = (),
        interchangeable: bool = False,
    ) -> None:
        self.process = process
        self.separate = tuple(separate)
        self.interchangeable = interchangeable
        self.manager = process.symbolic.manager
        self.random = random.Random(seed)
        self.generator = np.random.default_rng(seed)
        self.block_limit = block_limit
        self.progress = progress
        self.rounds = 0
        self.attempts = 0
        self.primes: list[int] = []
        self.labels = _Labels(self.manager.constant(0), np.zeros(1, dtype=np.uint64))
        self.propagation: Propagation | ListedRefinement | None = None
        self.listed: StateList | None = None
        self.as_list: ListedPartition | None = None
        self.race = Race()
        self.cuts: Cuts = {}
        self.denominator = common_denominator(process)
        self.use(Field() if self.denominator % MERSENNE_61 else Field(self.fresh_prime()))

    @property
    def blocks(self) -> int:
        """The blocks so far; the class of states outside a restriction is none."""
        return max(1, self.labels.blocks - self.has_outside)

    @property
    def has_outside(self) -> bool:
        """Whether there are states outside a restriction."""
        reachable = self.process.reachable
        return reachable is not None and not reachable.is_constant

    def use(self, field: Field) -> None:
        """Go on in another field, with fresh draws; start from the present partition."""
        self.field = field
        self.primes.append(field.prime)
        self.view = self.new_view(field)
        self.propagation = None
        self.labels.elements = field.draw(self.generator, self.labels.blocks)
        if self.interchangeable:
            self.polynomial = Polynomial(self.view, field, self.generator)

    def new_view(self, field: Field) -> ProcessView:
        """The process in a field, with fresh draws for observations and for parameters kept as symbols."""
        process = self.process
        if process.open_numbers is not None:
            process = process.open_numbers.draw(self.random, field.prime)
        numbers = NumericView(process.symbolic, field)
        sensed = (
            None if not process.channels else SensedRegression(numbers, process.channels, self.generator)
        )
        return ProcessView(process, numbers, sensed)

    def run(self, confirmations: int) -> None:
        self.begin()
        self.one_pass()
        passed = 0
        while passed < confirmations and not self.is_certain():
            self.use(Field(self.fresh_prime()))
            before = self.labels.blocks
            self.split_rewards()  # the rest of the beginning knows no numbers
            self.attempts += 1
            if self.one_pass() or self.labels.blocks > before:
                passed = 0
                if self.attempts >= EARLY:
                    self.refine()
            else:
                passed += 1

    def is_certain(self) -> bool:
        """Whether the partition is stable since no two states are left that could differ."""
        return not self.interchangeable and all_apart(self.view, self.labels.diagram, self.labels.blocks)

    def fresh_prime(self) -> int:
        """A random prime not used yet that divides no denominator of the model."""
        while True:
            prime = random_prime(self.random)
            if prime not in self.primes and self.denominator % prime:
                return prime

    def begin(self) -> None:
        """Separate by reachability, terminal flag, what is seen, applicable choices and rewards."""
        reachable = self.process.reachable
        terminal = self.process.terminal
        if reachable is not None:
            self.split(reachable)
            terminal = terminal & reachable
        self.split(terminal)
        if self.process.partial:
            self.split_seen()
        for diagram in self.separate:
            self.split(
                diagram if reachable is None else choose(reachable, diagram, self.manager.constant(0))
            )
        if not self.interchangeable:
            for choice in self.process.choices:
                self.split(self.view.app(choice))
        self.split_rewards()

    def split_rewards(self) -> None:
        """Separate by rewards: by a random linear form of those of all choices, or by their multiset."""
        if self.interchangeable:
            self.split(self.polynomial.of_rewards())
            return
        rewards = [self.view.reward(choice) for choice in self.process.choices]
        distinct = list(
            {reward.node: reward for reward in rewards if reward != self.view.numbers.zero}.values()
        )
        factors = self.field.draw(self.generator, len(distinct))
        if distinct:
            weights = [self.manager.stored_constant(factor, self.field) for factor in factors.tolist()]
            self.split(weighted_sum(weights, distinct))

    def split_seen(self) -> None:
        """Separate by the observed features: what is seen at every step, the end included."""
        symbolic = self.process.symbolic
        for number, feature in enumerate(symbolic.model.features):
            if feature.observed:
                variable = node(
                    self.manager,
                    symbolic.now(number),
                    [self.manager.constant(value) for value in range(len(feature.values))],
                )
                live = ~self.process.terminal
                if self.process.reachable is not None:
                    live = live & self.process.reachable
                self.split(choose(live, variable, self.manager.constant(0)))

    def refine(self) -> None:
        """Passes until nothing changes."""
        if self.interchangeable:
            while self.one_pass():
                pass
            return
        listed = state_list(self.view, self.labels.diagram)
        if isinstance(self.propagation, Propagation) and listed is not None:
            self.propagation.steps_allowed = listed.steps
            self.propagate(UNLIMITED)
            if not isinstance(self.propagation, Propagation) or not self.propagation.unfinished:
                return
            self.listed, self.propagation = listed, None
        self.propagate(UNLIMITED)

    def one_pass(self) -> bool:
        """Refine by every choice; answer whether a block was split."""
        if not self.interchangeable:
            return self.propagate(1)
        before = self.labels.blocks
        value = relabel(self.labels.diagram, self.labels.elements, self.field)
        memo: dict[int, Diagram] = {}
        if node_count(value) >= LARGE:
            for primitive in {p for choice in self.process.choices for p in choice.primitives}:
                result = self.race.regress(self.view.numbers, primitive, value)
                if result is not None:
                    memo[primitive] = result
        self.split(self.polynomial.of_rows(value, memo))
        self.rounds += 1
        self.report(self.rounds, self.labels.blocks)
        return self.labels.blocks > before

    def propagate(self, passes: int) -> bool:
        """Up to so many passes over the choices; answer whether a block was split."""
        if self.propagation is None:
            self.propagation = self.new_propagation()
        propagation, done = self.propagation, self.propagation.passes
        try:
            return propagation.run(passes)
        except Vanished:  # with a chance of some 1/p for each state
            self.keep(propagation)
            self.use(self.field)
            return True
        except TooManyBlocks:
            self.keep(propagation)
            self.check_limit()
            raise
        finally:
            self.keep(propagation)
            self.rounds += propagation.passes - done
            self.report(self.rounds, propagation.blocks)

    def new_propagation(self) -> Propagation | ListedRefinement:
        """The present partition as the start of passes in the present field."""
        outside = self.labels.blocks - self.blocks
        allowed = None if self.block_limit is None else self.block_limit + outside
        draw = partial(self.field.draw, self.generator)

        def look(passes: int, blocks: int) -> None:
            self.report(self.rounds + passes, blocks)

        if self.listed is not None:
            try:
                return ListedRefinement(
                    self.view, self.listed, self.labels.diagram, draw, allowed=allowed, look=look,
                    known=self.as_list,
                )  # fmt: skip
            except MemoryError:
                self.listed = None
        return Propagation(
            self.view, self.labels.diagram, self.labels.elements, draw, allowed=allowed, look=look,
            race=self.race, cuts=self.cuts,
        )  # fmt: skip

    def keep(self, propagation: Propagation | ListedRefinement) -> None:
        """The partition that it has come to."""
        self.as_list = propagation.partition if isinstance(propagation, ListedRefinement) else None
        self.labels = _Labels(propagation.labels, propagation.elements[: propagation.blocks])

    def report(self, rounds: int, labels: int) -> None:
        """Tell the progress."""
        if self.progress is not None:
            self.progress(rounds, max(1, labels - self.has_outside))

    def split(self, by: Diagram) -> None:
        """Replace the partition by the distinct pairs (block, leaf of `by`)."""
        if by.is_constant:
            return
        known = self.as_list
        if known is not None and known.diagram == self.labels.diagram and not known.is_split_by(by):
            return
        numbered, old_leaf, _ = pairs(self.labels.diagram, by)
        old = leaf_payloads(self.manager, old_leaf).astype(np.int64)
        if len(old) == self.labels.blocks:
            return
        elements = np.zeros(len(old), dtype=np.uint64)
        _, first = np.unique(old, return_index=True)
        elements[first] = self.labels.elements[old[first]]
        fresh = np.ones(len(old), dtype=bool)
        fresh[first] = False
        elements[fresh] = self.draw_new(int(fresh.sum()), elements[first])
        self.labels = _Labels(numbered, elements)
        self.check_limit()

    def check_limit(self) -> None:
        """Stop where there are too many blocks.

        Raises:
            LimitReached: there are.
        """
        if self.block_limit is not None and self.blocks > self.block_limit:
            raise LimitReached(
                f"more than {self.block_limit:,} blocks after {self.rounds} rounds",
                "minimisation",
                self.partition(),
            )

    def draw_new(self, count: int, taken: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
        """Random elements different from each other and from those in use."""
        drawn = self.field.draw(self.generator, count)
        while np.isin(drawn, taken).any():
            drawn = self.field.draw(self.generator, count)
        return drawn

    def partition(self) -> Partition:
        """The present partition, numbered canonically."""
        reachable = self.process.reachable
        return partition_from(self.process.symbolic, self.labels.diagram, reachable)

    def partition_so_far(self) -> Partition | None:
        """The partition when a limit has been reached; None where even that takes more memory."""
        deadline, self.manager.deadline = self.manager.deadline, None
        try:
            self.propagation = None
            self.manager.collect_garbage()
            return self.partition()
        except MemoryLimit:
            return None
        finally:
            self.manager.deadline = deadline
