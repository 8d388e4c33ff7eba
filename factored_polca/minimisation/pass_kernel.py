"""Passes of the refinement as one kernel: regress what has changed, split by that, until nothing changes.

With V = r o P now and V_0 what it was when the last pass began, D = V - V_0 is 0 but on the blocks that
were split since.  Regression is linear: in a block whose states have equal R_a[V_0],

    R_a[V] differs   exactly where   R_a[D] differs,

so a pass regresses D, which is sparse, and splits by that (`factored_polca.minimisation.split_kernel`).
Where nothing of a block is untouched the largest of its parts keeps its element, so that D holds the
smaller ones (Hopcroft 1971; Paige & Tarjan 1987).

For each choice c, with masks m_cp, the 0/1 diagrams of where c applies and stands for primitive p, and
with a random factor s_c,

    f_c = sum over p of m_cp R_p[D];     split by sum over c of s_c f_c.

The sum is one random linear form of all rows of a state: where some f_c differ it agrees with a chance of
1/p over s (Schwartz 1980), and one split does for all choices.

Primitive p is the row p of `first_weights`, `last_changed` and `keys`, as `run_regression` takes them, or,
where `width[p]` is not 0, the row p of those that `run_descent` takes.

    progress    [choice, stage, place in the choice's list of primitives]
    counts      [nodes of D]
    signatures  f_c [choice], of the choices done in this pass; one more, the sum of all
    factors     the leaf s_c [choice]
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.descent import FOUND, FRAMES, HEADER, SUMMING, run_descent
from factored_polca.diagrams.jit import inline, int64, lean_kernel
from factored_polca.diagrams.nodes import DONE, STEPS, Int32Array, Int64Array
from factored_polca.diagrams.weighted import (
    NORMALISED,
    ONE,
    ZERO,
    begin_sum,
    collect_possible,
    run_regression,
    run_weighted_sum,
)
from factored_polca.minimisation.split_kernel import (
    ALLOWED,
    BLOCKS,
    DIFFERENCE,
    LOOKED,
    NEXT,
    PASSES,
    ROOM,
    run_split,
)

UInt64Array = npt.NDArray[np.uint64]
FloatArray = npt.NDArray[np.float64]
Int32Table = npt.NDArray[np.int32]
Int64Table = npt.NDArray[np.int64]

PAUSE, BEYOND = 17, 18
"""Other answers: the caller may look around, between two passes or where it is time to collect garbage; the
blocks are more than allowed."""

CHOICE, STEP, PLACE = range(3)
"""Places in `progress`."""

GROUP = 32
"""Terms that are summed up at once: the cache soon forgets longer sums, whose keys fill it."""


@inline
def next_terms(
    terms: Int32Array, signatures: Int32Array, factors: Int32Array, count: int, zero: int,
    progress: Int64Array,
) -> int:  # fmt: skip
    """Terms s_c f_c from choice `progress[PLACE]` on, beside `count` there are; how many there are then."""
    choices = len(factors)
    while progress[PLACE] < choices and count < GROUP:
        j = progress[PLACE]
        if signatures[j] != zero:
            terms[2 * count] = factors[j]
            terms[2 * count + 1] = signatures[j]
            count += 1
        progress[PLACE] += 1
    while progress[PLACE] < choices and signatures[progress[PLACE]] == zero:
        progress[PLACE] += 1
    return count


@lean_kernel
def run_passes(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, cache: Int32Array,
    slots: Int64Array, ring: Int32Array, ring_state: Int64Array, stack: Int32Array, terms: Int32Array,
    results: Int32Array, words: Int32Array, sums: Int64Array, plain: Int64Array,
    operators: Int64Table, field: UInt64Array, one: np.uint64, inverses: UInt64Array,
    weights: Int32Array, first_weights: Int64Table, last_changed: Int64Array,
    keys: Int64Array, choice_first: Int64Array, choice_primitive: Int64Array, choice_mask: Int32Array,
    regressed: Int32Array, live: Int32Array, numbers: Int64Array, elements: UInt64Array,
    block_shares: UInt64Array, touched: UInt64Array, largest: Int32Array, fresh: UInt64Array,
    nodes: Int32Array, images: Int32Array, new_blocks: Int32Array, exact: UInt64Array,
    changes: UInt64Array, rough: FloatArray, changed: Int32Array, counts: Int64Array,
    sum_state: Int64Array, walked: Int64Array, state: Int64Array, work: Int64Array,
    progress: Int64Array, width: Int64Array, carried: Int64Table,
    row_roots: Int32Table, row_identity: Int32Table,
    row_fixed: Int32Table, row_base: Int64Table, row_last: Int64Array,
    entry_first: Int64Array, entry_value: Int32Array, entry_weight: Int32Array, entry_weights: Int32Array,
    frames: Int32Array, found: Int32Array, down: Int64Array, signatures: Int32Array, factors: Int32Array,
    collect_at: int, passes: int,
) -> int:  # fmt: skip
    """Passes over all choices until D is 0, or `passes` are done (counted in `numbers`).

    `regressed[p]` is R_p[D], 0 where it is not known yet; `changed` holds the nodes of D.  `walked` is the
    progress of `run_regression`, `sum_state` that of weighted sums, `state` that of binary operators.
    """
    leaf_level = len(arity) - 1
    choices = len(choice_first) - 1
    zero = sums[ZERO]
    while live[DIFFERENCE] != zero and passes > numbers[PASSES]:
        while progress[CHOICE] <= choices:  # the last is the form of all
            c = progress[CHOICE]
            first = choice_first[min(c, choices)]
            last = choice_first[min(c + 1, choices)]
            if progress[STEP] == 0:
                if head[0] > collect_at:
                    return PAUSE
                progress[PLACE] = first
                walked[0] = 0
                walked[1] = 0
                progress[STEP] = 1
            if progress[STEP] == 1:
                while progress[PLACE] < last:
                    p = choice_primitive[progress[PLACE]]
                    if regressed[p] == 0:
                        value = int64(live[DIFFERENCE])
                        if last_changed[p] < 0 or pool[value] == leaf_level:
                            regressed[p] = value
                        elif width[p] >= 0:
                            if down[FRAMES] == 0:
                                frames[0] = 0
                                frames[1] = 0
                                frames[2] = -1
                                frames[HEADER] = value
                                for j in range(width[p]):
                                    frames[HEADER + 1 + j] = row_roots[p, j]
                                down[FRAMES] = 1
                                down[FOUND] = 0
                                down[SUMMING] = 0
                            code = run_descent(
                                pool, head, unique, arity, slots, ring, ring_state, sums, field, stack,
                                terms, results, sum_state, keys[p], width[p], carried[p],
                                row_identity[p], row_fixed[p], row_base[p], row_last[p], entry_first,
                                entry_value, entry_weight, entry_weights, frames, found, down,
                            )  # fmt: skip
                            if code != DONE:
                                return code
                            regressed[p] = found[0]
                            down[FRAMES] = 0
                        else:
                            if walked[0] == 0 and walked[1] == 0:
                                if len(changed) <= head[1]:
                                    return ROOM
                                counts[0] = collect_possible(
                                    pool, arity, value, changed, stack, weights, first_weights[p],
                                    last_changed[p], zero,
                                )  # fmt: skip
                                if counts[0] == 0:
                                    regressed[p] = zero
                                    progress[PLACE] += 1
                                    continue
                            code = run_regression(
                                pool, head, unique, arity, slots, ring, ring_state, sums, field,
                                stack, terms, results, sum_state, cache, keys[p], changed,
                                counts[0], weights, first_weights[p], last_changed[p], images, walked,
                            )  # fmt: skip
                            if code != DONE:
                                return code
                            regressed[p] = images[counts[0] - 1]
                            walked[0] = 0
                            walked[1] = 0
                    progress[PLACE] += 1
                count = int64(0)
                for j in range(first, last):
                    part = regressed[choice_primitive[j]]
                    if part != zero:
                        terms[2 * count] = choice_mask[j]
                        terms[2 * count + 1] = part
                        count += 1
                if c == choices:
                    progress[PLACE] = 0
                    count = next_terms(terms, signatures, factors, int64(0), zero, progress)
                begin_sum(stack, sum_state, count, plain[NORMALISED])
                progress[STEP] = 2
                if count == 0:
                    signatures[c] = zero
                    progress[STEP] = 0
                elif count == 1 and (c == choices or terms[0] == plain[ONE]):
                    signatures[c] = terms[1]
                    progress[STEP] = 0
            if progress[STEP] == 2:
                code = run_weighted_sum(
                    pool, head, unique, arity, slots, ring, ring_state, plain, field, stack, terms,
                    results, sum_state,
                )  # fmt: skip
                if code != DONE:
                    return code
                head[2] += STEPS - sum_state[2]
                sum_state[2] = STEPS
                signatures[c] = results[0]
                if c == choices and progress[PLACE] < choices:
                    terms[0] = plain[ONE]
                    terms[1] = signatures[c]
                    count = next_terms(terms, signatures, factors, int64(1), zero, progress)
                    begin_sum(stack, sum_state, count, plain[NORMALISED])
                    continue
                progress[STEP] = 0
            progress[CHOICE] += 1
        code = run_split(
            pool, head, unique, arity, cache, stack, results, words, signatures[choices], operators,
            field, one, inverses, live, numbers, elements, block_shares, touched, largest, fresh,
            nodes, images, new_blocks, exact, changes, rough, state, work,
        )  # fmt: skip
        if code != DONE:
            return code
        live[DIFFERENCE] = live[NEXT]
        live[NEXT] = zero
        for p in range(len(regressed)):
            regressed[p] = 0
        progress[CHOICE] = 0
        numbers[PASSES] += 1
        if numbers[BLOCKS] > numbers[ALLOWED]:
            return BEYOND
        if head[2] - numbers[LOOKED] > STEPS // 8:
            numbers[LOOKED] = head[2]
            return PAUSE
    return DONE
