"""The walk of `factored_polca.minimisation.push` in GF(p), for comparing columns of a kernel exactly.

A module of its own, loaded where columns have to be compared: few models need this kernel compiled.
"""

from __future__ import annotations

import numpy as np

from factored_polca.diagrams.field import UInt64Array, field_add, field_multiply
from factored_polca.diagrams.jit import kernel
from factored_polca.minimisation.push import Int32Array, Int64Array


@kernel
def add_forms(
    roots: Int32Array, slot: Int32Array, first_child: Int64Array, children: Int32Array,
    leaf: Int64Array, start: Int64Array, value: Int32Array, residue: UInt64Array, chosen: Int32Array,
    blocks: Int64Array, pointers: Int64Array, ends: Int64Array, target: Int64Array, joint: Int64Array,
    s: UInt64Array, r: UInt64Array, parameters: UInt64Array, one: UInt64Array, sums: UInt64Array,
) -> None:  # fmt: skip
    """Walk some states' masses down a plan in GF(p) and add s r mass to `sums` [k, t] at their entries.

    Places are numbered level by level, so one sweep meets each after all that lead to it.
    """
    prime, inverse = parameters[0], parameters[1]
    places = len(slot)
    largest = 0
    for q in range(places):
        largest = max(largest, leaf[q])
    mass = np.zeros(places, np.uint64)
    total = np.zeros(largest + 1, np.uint64)
    zero = np.uint64(0)
    for row in range(len(chosen)):
        total[:] = zero
        for j in range(len(roots)):
            mass[roots[j]] = field_add(mass[roots[j]], one[0], prime)
        for q in range(places):
            m = mass[q]
            if m == zero:
                continue
            mass[q] = zero
            if slot[q] < 0:
                total[leaf[q]] = field_add(total[leaf[q]], m, prime)
                continue
            drawn = chosen[row, slot[q]]
            for e in range(start[drawn], start[drawn + 1]):
                child = children[first_child[q] + value[e]]
                if child >= 0:
                    part = field_multiply(m, residue[e], prime, inverse)
                    mass[child] = field_add(mass[child], part, prime)
        for i in range(pointers[row], pointers[row + 1]):
            for k in range(2):
                weight = field_multiply(s[k, blocks[row]], r[k, target[i]], prime, inverse)
                part = field_multiply(weight, total[ends[i]], prime, inverse)
                sums[k, joint[i]] = field_add(sums[k, joint[i]], part, prime)
