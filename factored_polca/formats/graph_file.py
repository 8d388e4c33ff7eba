"""Policy graphs: the `.pg` files of pomdp-solve.

    file ::= {line}
    line ::= NODE ACTION successor successor ...     a successor for each observation, `-` or `X` for none

Nodes are numbered from 0 in the order of the file; node n belongs to vector n of the `.alpha` file beside
it, so that the first node is the one whose vector is best at the start: the file does not name it.
Observations are those of the file that `write_pomdp` makes of the same arrays (see `cassandra_factoring`).
For a model that was read from a file their order is that of the file, which arrays do not keep: `labels`
gives it, `observation=NAME` for each.

Source: A. R. Cassandra, "POMDP-Solve: policy graph file format", pomdp.org, 2003.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import IntArray
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.cassandra_factoring import factored, seen_label
from factored_polca.formats.policy_words import Word, lines_of
from factored_polca.models.errors import Fault, ModelError

MAXIMUM_NODES: Final = 1_000_000
"""Nodes of one file."""
MAXIMUM_SUCCESSORS: Final = 20_000_000
"""Successors of one file."""


def write_graph(graph: PolicyGraph, pomdp: ArrayPOMDP) -> str:
    """`graph`, a policy of `pomdp`, for the file that `write_pomdp` makes of `pomdp`.

    Raises:
        ModelError: arrays that the format can't express, or a node that moves on by something that the
            file's observations do not tell.
    """
    labels = _labels(pomdp)
    lines = []
    for node, action in enumerate(graph.actions.tolist()):
        found: dict[int, int] = {}
        for o, y, column in _cells(pomdp, action, labels):
            after = int(graph.successors[node][o, y])
            if after >= 0 and found.setdefault(column, after) != after:
                raise ModelError(f"node {node} moves on by what is seen of the state, which the file's "
                                 "observations do not tell")  # fmt: skip
        shown = (str(found[k]) if k in found else "-" for k in range(len(labels)))
        lines.append(f"{node} {action} {' '.join(shown)}")
    return "\n".join(lines) + "\n"


def read_graph(
    text: str,
    pomdp: ArrayPOMDP,
    start: int | Sequence[int] = 0,
    *,
    labels: Sequence[str] | None = None,
) -> PolicyGraph:
    """The policy graph of a file for what `write_pomdp` makes of `pomdp`.

    `start` is the first node, or one for each number of `observed`; `labels` names the observations of the
    file where they are others, or in another order.

    Raises:
        ModelError: a text that is not right, with line and column; or a first node that is not there.
    """
    labels = _labels(pomdp) if labels is None else labels
    rows = list(_rows(text, len(labels)))
    if not rows:
        raise ModelError([Fault("a policy graph without a node", line=1, column=1)])
    kinds = int(pomdp.observed.max()) + 1
    actions, successors = [], []
    for node, words in enumerate(rows):
        if words[0].integer("node", len(rows)) != node:
            raise words[0].error(f"node {words[0].text} stands where node {node} is expected",
                                 "nodes are numbered from 0 in the order of the file")  # fmt: skip
        action = words[1].integer("action", len(pomdp.actions))
        after = [-1 if w.text in ("-", "X") else w.integer("node", len(rows)) for w in words[2:]]
        table: IntArray = np.full((len(pomdp.observations[action]), kinds), -1, dtype=np.int64)
        for o, y, column in _cells(pomdp, action, labels):
            table[o, y] = after[column]
        actions.append(action)
        successors.append(table)
    first = np.full(kinds, start, dtype=np.int64) if isinstance(start, int) else np.array(start, np.int64)
    if first.shape != (kinds,) or np.any((first < -1) | (first >= len(rows))):
        raise ModelError(f"the first node is none of 0 to {len(rows) - 1}")
    return PolicyGraph(np.array(actions, dtype=np.int64), tuple(successors), first)


def _labels(pomdp: ArrayPOMDP) -> tuple[str, ...]:
    arrays = factored(pomdp)
    if arrays.observations is None:
        raise ModelError("every state is seen: a policy is a table of states, not a graph of observations")
    return arrays.labels


def _cells(pomdp: ArrayPOMDP, action: int, labels: Sequence[str]) -> Iterator[tuple[int, int, int]]:
    """(o, y, column): the column of the file for each observation of an action and what is seen."""
    columns = {label: k for k, label in enumerate(labels)}
    for o, label in enumerate(pomdp.observations[action]):
        for y in range(int(pomdp.observed.max()) + 1):
            column = columns.get(label, columns.get(seen_label(label, y)))
            if column is not None:
                yield o, y, column


def _rows(text: str, observations: int) -> Iterator[list[Word]]:
    for number, words in enumerate(lines_of(text)):
        if number >= MAXIMUM_NODES or number * observations > MAXIMUM_SUCCESSORS:
            raise words[0].error(f"more than {MAXIMUM_NODES} nodes or {MAXIMUM_SUCCESSORS} successors")
        if len(words) != observations + 2:
            message = f"a node with {max(0, len(words) - 2)} successors for {observations} observations"
            raise words[-1].error(message, "NODE ACTION and a node, '-' or 'X' for each observation")
        yield words
