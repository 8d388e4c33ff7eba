"""Joint columns of a quotient's kernel that are proportional, found by residues (DESIGN 4).

Column o of a choice is the matrix K(C; C', o).  Columns with K(.; ., o') = l K(.; ., o) leave the same
belief and are merged.  For two random bilinear forms

    F_k(o) = sum over C, C' of s_kC r_kC' K(C; C', o),   k = 1, 2,   in GF(p),

F_1(o) F_2(o') - F_2(o) F_1(o') is 0 where the columns are proportional; elsewhere it is a polynomial of
degree 4 in the draws, not 0 unless p divides it, so that it vanishes with probability at most 4 / p
(Schwartz 1980; Zippel 1979).  Hence o and o' are merged where F_1 / F_2 is the same.  p is a prime drawn
at random from [2^60, 2^61), as in `refine`.

Floats only rule out: the ratio of two such forms with random positive weights differs between columns
that are clearly not proportional, and then nothing is computed in the field.  Not to merge is never wrong.

Entries of the kernel come as masses of (C, end) with an end's block C' and the number t of the rows that
the channels have there, so that K(C; C', o) = sum over its ends of mass * P_t(o) and

    F_k(o) = sum over t of P_t(o) A_k[t],   A_k[t] = sum over the entries of t of s_kC r_kC' mass.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Field, random_prime
from factored_polca.minimisation.push import FloatArray, Int32Array, Int64Array, PushPlan, RowTable
from factored_polca.models import LimitReached

CLOSE = 1e-9
"""Ratios of float forms that differ by more, relatively, are of different columns: they carry the rounding
of sums of positive products, some 1e-16 times the number of features and channels."""

WAYS_OUT = "let the task observe fewer channels (`observes`), give them fewer values"

STATES_AT_ONCE = 512
"""States walked in the field before control comes back, so that Ctrl-C is seen."""


@dataclass(frozen=True)
class JointTable:
    """P_t(o) for each number t of channel rows: entries sorted by t, positive ones only.

    `digits[o]` are the merged values of the channels, lexicographically ascending.
    """

    start: Int64Array  # [t], one more at the end
    observation: Int64Array  # [entry]
    chance: FloatArray  # [entry]
    digits: Int32Array  # [o, channel]

    @property
    def numbers(self) -> Int64Array:
        """The t of each entry."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def merged(self, image: Int64Array) -> JointTable:
        """The table with observation o counted as image[o]; `digits` are those of the first members."""
        count = int(image.max()) + 1
        key = self.numbers * count + image[self.observation]
        distinct, inverse = np.unique(key, return_inverse=True)
        chance = np.bincount(inverse.reshape(-1), weights=self.chance).astype(np.float64)
        start = np.searchsorted(distinct, np.arange(len(self.start)) * count)
        _, first = np.unique(image, return_index=True)
        return JointTable(start, distinct % count, chance, self.digits[first])


@dataclass(frozen=True)
class Pushed:
    """The entries (state, end) of one primitive's walk, and what their exact masses are made from.

    State i of the walk is block `blocks[i]`; its entries are those from `pointers[i]` to `pointers[i + 1]`,
    each with its end's block and its number t.
    """

    plan: PushPlan
    table: RowTable
    chosen: Int32Array  # [i, slot]
    blocks: Int64Array  # [i]
    pointers: Int64Array  # [i], one more at the end
    ends: Int64Array  # [entry]
    masses: FloatArray  # [entry]
    target: Int64Array  # [entry] the end's block
    joint: Int64Array  # [entry] t

    @property
    def source(self) -> Int64Array:
        """The block that each entry starts from."""
        return np.repeat(self.blocks, np.diff(self.pointers))


@dataclass(frozen=True)
class Limits:
    """How many joint observations of a choice, and entries of all choices, may be listed."""

    observations: int
    entries: int


def joint_table(
    tuples: Int32Array, rows: Sequence[Sequence[Sequence[Fraction]]], limits: Limits, choice: str, left: str
) -> JointTable:
    """P_t(o) for the rows `tuples` [t, channel]; only observations that occur get a number.

    Args:
        rows: [channel][row] the probabilities of the channel's merged values.
        choice: named where there are too many, together with
        left: the numbers of values of its channels.

    Raises:
        LimitReached: more observations or entries than allowed.
    """
    source, code, chance = np.arange(len(tuples)), np.zeros(len(tuples), np.int64), np.ones(len(tuples))
    digits = np.zeros((1, 0), dtype=np.int64)
    for channel, listed in enumerate(rows):
        entries = [[(v, float(q)) for v, q in enumerate(row) if q] for row in listed]
        start = np.cumsum([0, *map(len, entries)])
        value = np.array([v for row in entries for v, _ in row])
        share = np.array([q for row in entries for _, q in row])
        chosen = tuples[source, channel]
        count = start[chosen + 1] - start[chosen]
        if count.sum() > limits.entries:
            raise LimitReached(
                f"choice {choice!r}: the joint rows of its channels ({left}) have more than "
                f"{limits.entries:,} entries; {WAYS_OUT}, or raise maximum_entries",
                "quotient",
            )
        owner = np.repeat(np.arange(len(source)), count)
        entry = np.arange(len(owner)) + (start[chosen] - np.cumsum(count) + count)[owner]
        size = len(listed[0])
        key = code[owner] * size + value[entry]
        occurs = np.zeros(len(digits) * size, dtype=np.bool_)
        occurs[key] = True
        distinct = np.flatnonzero(occurs)
        if len(distinct) > limits.observations:
            raise LimitReached(
                f"choice {choice!r} has more than {limits.observations:,} joint observations; its "
                f"channels and their values left after merging are {left}; {WAYS_OUT}, or raise "
                "maximum_observations",
                "quotient",
            )
        digits = np.column_stack([digits[distinct // size], distinct % size])
        source, code, chance = source[owner], np.cumsum(occurs)[key] - 1, chance[owner] * share[entry]
    start = np.searchsorted(source, np.arange(len(tuples) + 1))
    return JointTable(start, code, chance, digits.astype(np.int32))


def candidates(
    pieces: Sequence[Pushed], table: JointTable, blocks: int, seed: int
) -> Iterator[npt.NDArray[np.int64]]:
    """Groups of two or more observations whose columns floats can't tell from proportional ones."""
    if len(table.digits) < 2:
        return
    generator = np.random.default_rng(seed)
    s, r = generator.uniform(0.5, 1.5, (2, blocks + 1))
    numbers = len(table.start) - 1
    mass, weighed = np.zeros(numbers), np.zeros(numbers)
    for piece in pieces:
        mass += np.bincount(piece.joint, weights=piece.masses, minlength=numbers)
        weights = piece.masses * s[piece.source] * r[piece.target]
        weighed += np.bincount(piece.joint, weights=weights, minlength=numbers)
    per_entry = np.repeat(np.stack([mass, weighed]), np.diff(table.start), axis=1) * table.chance
    below, above = (np.bincount(table.observation, weights=part) for part in per_entry)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = above / below
    ratio[~(below > 1e-250)] = np.nan  # rounding to 0 has spoilt it
    order = np.argsort(ratio)
    gaps = ~(np.diff(ratio[order]) <= CLOSE * ratio[order][1:])
    for group in np.split(order, np.flatnonzero(gaps) + 1):
        if len(group) > 1:
            yield np.sort(group)


def merge_columns(
    pieces: Sequence[Pushed],
    table: JointTable,
    rows: Sequence[Sequence[Sequence[Fraction]]],
    tuples: Int32Array,
    blocks: int,
    seed: int,
) -> Int64Array:
    """The merged number of each observation [o]; merged ones are numbered by their first member.

    Args:
        pieces: the entries of the choice's primitives.
        table: P_t(o), one entry a pair.
        rows: [channel][row] the probabilities of the channel's merged values.
        tuples: [t, channel] the channels' rows.
        blocks: the number of blocks.
    """
    count = len(table.digits)
    image = np.arange(count)
    groups = list(candidates(pieces, table, blocks, seed))
    if not groups:
        return image
    source = random.Random(seed)
    exact = [q for row in rows for chances in row for q in chances]
    exact += [q for piece in pieces for row in piece.table.exact for _, q in row]
    field = Field(random_prime(source))
    while any(q.denominator % field.prime == 0 for q in exact):
        field = Field(random_prime(source))
    forms = _entry_forms(pieces, len(tuples), blocks, field, seed)
    residues = [[[_residue(q, field.prime) for q in row] for row in channel] for channel in rows]
    numbers = table.numbers
    by_observation = np.argsort(table.observation, kind="stable")
    bounds = np.searchsorted(table.observation[by_observation], np.arange(count + 1))
    for group in groups:
        known: dict[int, int] = {}
        for o in group.tolist():
            entries = by_observation[bounds[o] : bounds[o + 1]]
            first, second = _column_forms(
                forms, residues, tuples[numbers[entries]], numbers[entries], table.digits[o], field.prime
            )
            if second:
                ratio = first * pow(second, -1, field.prime) % field.prime
                image[o] = known.setdefault(ratio, o)
    _, result = np.unique(image, return_inverse=True)
    return result.reshape(-1).astype(np.int64)


def _residue(value: Fraction, prime: int) -> int:
    return value.numerator * pow(value.denominator, -1, prime) % prime


def _column_forms(
    forms: Sequence[Sequence[int]],
    residues: Sequence[Sequence[Sequence[int]]],
    tuples: Int32Array,
    numbers: Int64Array,
    digits: Int32Array,
    prime: int,
) -> tuple[int, int]:
    """F_1 and F_2 of the observation with these digits, from the t [i] where it is possible."""
    first = second = 0
    values = digits.tolist()
    for t, row_numbers in zip(numbers.tolist(), tuples.tolist(), strict=True):
        chance = 1
        for channel, (number, value) in enumerate(zip(row_numbers, values, strict=True)):
            chance = chance * residues[channel][number][value] % prime
        first += chance * forms[0][t]
        second += chance * forms[1][t]
    return first % prime, second % prime


def _entry_forms(
    pieces: Sequence[Pushed], numbers: int, blocks: int, field: Field, seed: int
) -> list[list[int]]:
    """A_1 and A_2 as integers mod p, each [t]."""
    from factored_polca.minimisation.push_residues import add_forms  # compiled only where it is needed

    generator = np.random.default_rng(seed)
    s, r = (np.stack([field.draw(generator, blocks + 1) for _ in range(2)]) for _ in range(2))
    sums = np.zeros((2, numbers), dtype=np.uint64)
    one = np.array([field.encode(1)], dtype=np.uint64)
    for piece in pieces:
        plan, table = piece.plan, piece.table
        residue = np.array([field.rational(q) for row in table.exact for _, q in row], dtype=np.uint64)
        for begin in range(0, len(piece.blocks), STATES_AT_ONCE):
            end = begin + STATES_AT_ONCE
            add_forms(
                plan.roots, plan.slot, plan.first_child, plan.children, plan.leaf, table.start,
                table.value, residue, piece.chosen[begin:end], piece.blocks[begin:end],
                piece.pointers[begin : end + 1], piece.ends, piece.target, piece.joint, s, r,
                field.parameters, one, sums,
            )  # fmt: skip
    return [[field.decode(int(stored)) for stored in row] for row in sums]
