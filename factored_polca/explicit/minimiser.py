"""The coarsest stable partition of an enumerated MDP, by brute force in exact rationals.

Two states are equivalent if both are terminal, or if they have the same applicable actions and for
each of these the same reward and, for each block, the same probability of entering it (Dean & Givan
1997; Givan, Dean & Greig 2003).  Start from terminal flag, applicable set and rewards, and split by
the probabilities of entering the blocks until nothing splits.

This is the oracle for `factored_polca.minimisation`: no fingerprints, no diagrams, only signatures
written out in full and compared as they are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from factored_polca.explicit.exact_mdp import ExactMDP, Row
from factored_polca.explicit.exact_pomdp import ExactPOMDP

OUTSIDE = -1
"""The block number of states that were left out."""


@dataclass(frozen=True)
class ExactPartition:
    """Block numbers by first occurrence in the order of the states.

    `initial_blocks` counts the blocks of the first split, `rounds` the splits by transitions, the
    last of which, having split nothing, shows that the partition is stable.
    """

    block_of: tuple[int, ...]  # [s], `OUTSIDE` for states left out
    blocks: int
    initial_blocks: int
    rounds: int

    def members(self) -> tuple[tuple[int, ...], ...]:
        """The states of each block, in their order."""
        return tuple(
            tuple(s for s, block in enumerate(self.block_of) if block == number)
            for number in range(self.blocks)
        )

    @property
    def representatives(self) -> tuple[int, ...]:
        """The first state of each block."""
        return tuple(self.block_of.index(number) for number in range(self.blocks))


def minimise(mdp: ExactMDP, states: Sequence[bool] | None = None) -> ExactPartition:
    """The coarsest stable partition of `mdp`.

    With `states` (for example from `reachable_states`) only those are partitioned; all others form
    one class of their own, which is neither split nor counted.

    Raises:
        ValueError: `states` has another length than the MDP.
    """
    inside = [True] * mdp.states if states is None else list(states)
    if len(inside) != mdp.states:
        raise ValueError(f"`states` has {len(inside)} entries for {mdp.states} states")
    block_of, blocks = _number([_first_signature(mdp, s) for s in range(mdp.states)], inside)
    initial_blocks, rounds = blocks, 0
    rows = [_over_one_denominator(action) for action in mdp.rows]
    while True:
        rounds += 1
        signatures = [_signature(rows, s, block_of) for s in range(mdp.states)]
        refined, count = _number(signatures, inside)
        if count == blocks:
            return ExactPartition(tuple(block_of), blocks, initial_blocks, rounds)
        block_of, blocks = refined, count


def minimise_interchangeable(mdp: ExactMDP, *, as_sets: bool = False) -> ExactPartition:
    """The coarsest partition that keeps the multiset, or set, of the applicable actions' signatures.

    The signature of an action at a state is its reward and its probability of entering each block.  With
    sets these are the classes of the coarsest homomorphism (Ravindran & Barto 2003), names aside.
    """
    states, inside = range(mdp.states), [True] * mdp.states
    block_of, blocks = _number(["terminal" if mdp.terminal[s] else "live" for s in states], inside)
    initial_blocks, rounds = blocks, 0
    while True:
        rounds += 1
        signatures: list[Hashable] = []
        for s in states:
            found = [
                (mdp.rewards[a][s], _mass_by_block(mdp.rows[a][s], block_of))
                for a in range(len(mdp.actions))
                if mdp.applicable[a][s]
            ]
            counted = frozenset(found) if as_sets else frozenset(Counter(found).items())
            signatures.append((block_of[s], None if mdp.terminal[s] else counted))
        refined, count = _number(signatures, inside)
        if count == blocks:
            return ExactPartition(tuple(block_of), blocks, initial_blocks, rounds)
        block_of, blocks = refined, count


def minimise_pomdp(pomdp: ExactPOMDP) -> ExactPartition:
    """The coarsest partition of a POMDP that Eq. 13 of the paper keeps stable.

    Two states are equivalent if both are terminal, or if the same is seen of them and for each action
    they have the same reward and, for each block and each observation, the same probability of entering
    the block with that observation (Pineau, Gordon & Thrun 2003, Eq. 13; DESIGN 4).
    """
    states, inside = range(pomdp.states), [True] * pomdp.states
    actions = range(len(pomdp.actions))
    first = [
        "terminal"
        if pomdp.terminal[s]
        else (pomdp.observed[s], tuple(pomdp.rewards[a][s] for a in actions))
        for s in states
    ]
    block_of, blocks = _number(first, inside)
    initial_blocks, rounds = blocks, 0
    while True:
        rounds += 1
        signatures = [
            (block_of[s], *(_entering(pomdp.kernel[a][s], block_of) for a in actions)) for s in states
        ]
        refined, count = _number(signatures, inside)
        if count == blocks:
            return ExactPartition(tuple(block_of), blocks, initial_blocks, rounds)
        block_of, blocks = refined, count


def _mass_by_block(row: Row, block_of: Sequence[int]) -> frozenset[tuple[int, Fraction]]:
    """The probability of entering each block."""
    mass: dict[int, Fraction] = {}
    for t, chance in row.items():
        mass[block_of[t]] = mass.get(block_of[t], Fraction(0)) + chance
    return frozenset(mass.items())


def _entering(
    row: Mapping[tuple[int, int], Fraction], block_of: Sequence[int]
) -> frozenset[tuple[tuple[int, int], Fraction]]:
    """The probability of each (block, observation)."""
    mass: dict[tuple[int, int], Fraction] = {}
    for (t, o), chance in row.items():
        key = (block_of[t], o)
        mass[key] = mass.get(key, Fraction(0)) + chance
    return frozenset(mass.items())


def _number(signatures: Sequence[Hashable], inside: Sequence[bool]) -> tuple[list[int], int]:
    numbers: dict[Hashable, int] = {}
    block_of = [
        numbers.setdefault(signature, len(numbers)) if included else OUTSIDE
        for signature, included in zip(signatures, inside, strict=True)
    ]
    return block_of, len(numbers)


def _first_signature(mdp: ExactMDP, s: int) -> Hashable:
    if mdp.terminal[s]:
        return "terminal"
    return tuple(
        mdp.rewards[a][s] if mdp.applicable[a][s] else "not applicable" for a in range(len(mdp.actions))
    )


def _over_one_denominator(rows: Sequence[Row]) -> list[list[tuple[int, int]]]:
    """The rows of an action as pairs (next state, numerator) over their least common denominator.

    Sums of these integers are equal exactly where the sums of the rationals are, and much cheaper.
    """
    common = math.lcm(*(chance.denominator for row in rows for chance in row.values()))
    return [[(t, int(chance * common)) for t, chance in row.items()] for row in rows]


def _signature(
    rows: Sequence[Sequence[Sequence[tuple[int, int]]]], s: int, block_of: Sequence[int]
) -> Hashable:
    """The old block, and for each action the probability of entering each block."""
    entering = []
    for action in rows:
        mass: dict[int, int] = {}
        for t, numerator in action[s]:
            mass[block_of[t]] = mass.get(block_of[t], 0) + numerator
        entering.append(frozenset(mass.items()))
    return (block_of[s], tuple(entering))
