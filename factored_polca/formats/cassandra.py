"""Cassandra's format for flat POMDPs and MDPs, the `.POMDP` files of pomdp-solve.

    file     ::= {preamble} {entry}
    preamble ::= "discount" ":" number
               | "values" ":" ("reward" | "cost")                    left out: reward
               | ("states" | "actions" | "observations") ":" (COUNT | NAME {NAME})
               | "start" ":" (number {number} | "uniform" | state)   left out: uniform
               | "start" ("include" | "exclude") ":" state {state}   uniform over these, or the others
    entry    ::= "T" ":" action ":" state ":" state' number
               | "T" ":" action ":" state row
               | "T" ":" action (matrix | "identity")                rows are states, columns next states
               | "O" ":" action ":" state' ":" observation number
               | "O" ":" action ":" state' row
               | "O" ":" action (matrix | "identity")                rows are next states
               | "R" ":" action ":" state ":" state' ":" observation number
               | "R" ":" action ":" state ":" state' number {number}   a number for each observation
               | "R" ":" action ":" state number {number}              rows are next states
    row      ::= number {number} | "uniform" | "reset"
    matrix   ::= number {number} | "uniform" | "reset"

`# ...` is a comment; white space separates and has no other meaning.  Each index is a name, a number
counted from 0, or `*` for all.  Later entries override earlier ones in the order of the file,
wildcards or not.  Probabilities that no entry sets are 0, and so are rewards.  A row `reset` is the
start distribution.  T is P(s' | s, a), O is P(o | a, s'): observations come after the action and tell
of the next state; R is R(a, s, s', o).  With `values: cost` the numbers of R are costs, R is their
negative.  A file without `observations:` is an MDP: it has no O, and R lacks the last index
(`: *` may still stand there).

The model read has one feature `state` and, in a POMDP, one observation feature `observation`.  Their
values are the names listed, or the integers 0, 1, ... where a count is given.  A state that most
states of an action's table persist in is not spelled out, a reward mentions `state`, `state'` and
`observation` only as far as it depends on them.

Numbers are exact decimals, 0.1 is 1/10.  A row that misses the sum 1 by less than 1e-4 is divided by
its sum, with one warning for the file; a larger miss is an error, and so is a transition or
observation row that no entry sets.  More lenient than pomdp-solve: numbers such as `.5`, names with
`.` inside, names that are words of the format, `states: 0 1 2` for `states: 3`, `reset` for a matrix.

Written are arrays, with all states of a model listed or its blocks.  What the format lacks is brought in so
that every policy keeps its value: see `factored_polca.formats.cassandra_factoring` for observations that
depend on the state before, observed features and terminal states.

Sources: A. R. Cassandra, "POMDP file format" and "POMDP file grammar", pomdp.org, 1999 to 2005.
"""

from __future__ import annotations

from dataclasses import replace

from scipy.sparse import csr_array

from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.cassandra_reader import read_pomdp_with_warnings
from factored_polca.formats.cassandra_writer import write_factored, write_mdp, write_pomdp
from factored_polca.models.errors import Fault, LimitReached, ModelError
from factored_polca.models.model import Model
from factored_polca.models.scalars import describe, scalar

__all__ = [
    "plainly_labelled", "read_pomdp", "read_pomdp_with_warnings", "write_factored", "write_mdp",
    "write_model", "write_pomdp",
]  # fmt: skip

MAXIMUM_LISTED = 20_000
"""States of a model that `write_model` lists."""


def read_pomdp(text: str, name: str) -> Model:
    """The model that `text` describes, called `name`.

    Raises:
        ModelError: the text is not right, or asks for more work than the limits allow; every fault
            has a line and a column.
    """
    return read_pomdp_with_warnings(text, name)[0]


def write_model(model: Model) -> str:
    """`model` with all its states listed, in Cassandra's format.

    Raises:
        ModelError: the model is not right, has more than `MAXIMUM_LISTED` states, or can't be expressed.
    """
    try:
        exact = enumerate_pomdp(model, maximum_states=MAXIMUM_LISTED)
    except LimitReached:
        message = f"{model.states} states, which this format lists, are more than {MAXIMUM_LISTED}"
        raise ModelError([Fault(message, hint="write the quotient: convert --minimise")]) from None
    shown = [
        ", ".join(f"{f.name}={describe(scalar(v))}" for f, v in zip(model.features, values, strict=True))
        for values in exact.state_values
    ]
    return write_pomdp(plainly_labelled(exact.to_arrays(), model), model.name, shown)


def plainly_labelled(pomdp: ArrayPOMDP, model: Model) -> ArrayPOMDP:
    """The arrays of `model`; what its only channel says is not called `channel=value` but `value`.

    The first action has all that the channel says, in its order: so a file that was read keeps its own.
    """
    if len(model.observations) != 1:
        return pomdp
    (channel,) = model.observations
    start = f"{channel.name}="
    rows = [tuple(label.removeprefix(start) for label in row) for row in pomdp.observations]
    labels = tuple(describe(scalar(value)) for value in channel.values)
    first = dict(zip(rows[0], pomdp.kernel[0], strict=True))
    nothing = csr_array((pomdp.states, pomdp.states))
    kernel = (tuple(first.get(label, nothing) for label in labels), *pomdp.kernel[1:])
    return replace(pomdp, observations=(labels, *rows[1:]), kernel=kernel)
