"""Multi-valued, multi-terminal decision diagrams: ordered, reduced, hash-consed; kernels in numba.

Two nouns: `Manager`, the one mutable thing, owned by one thread, and `Diagram`, a handle on a
function of the manager's variables.  Knows nothing of models.
"""

from factored_polca.diagrams.diagram import Diagram
from factored_polca.diagrams.elimination import argmax, argmax_out, max_out, sum_out
from factored_polca.diagrams.field import MERSENNE_61, Field, is_prime, random_prime
from factored_polca.diagrams.leaves import FLOAT, INDEX, LeafType
from factored_polca.diagrams.manager import Aborted, Manager, MemoryLimit
from factored_polca.diagrams.operations import (
    apply,
    choose,
    cofactors,
    combine,
    move,
    pairs,
    relabel,
    renumber,
    restrict,
    substitute_leaves,
    support,
    weighted_sum,
)
from factored_polca.diagrams.operators import OPERATORS
from factored_polca.diagrams.queries import (
    at,
    dump,
    evaluate_states,
    leaves,
    load,
    node_count,
    states_for_leaves,
    states_of_leaves,
)

__all__ = [
    "FLOAT", "INDEX", "MERSENNE_61", "OPERATORS", "Aborted", "Diagram", "Field", "LeafType", "Manager",
    "MemoryLimit", "apply", "argmax", "argmax_out", "at", "choose", "cofactors", "combine", "dump",
    "evaluate_states", "is_prime", "leaves", "load", "max_out", "move", "node_count", "pairs",
    "random_prime", "relabel", "renumber", "restrict", "states_for_leaves", "states_of_leaves",
    "substitute_leaves", "sum_out", "support", "weighted_sum",
]  # fmt: skip
