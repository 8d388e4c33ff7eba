"""Decision processes as plain arrays by name, and as files in numpy's format .npz.

    MDP     transitions [a, s, t], rewards [a, s], applicable [a, s], terminal [s], initial [s],
            discount, actions [a]
    POMDP   kernel [a, o, s, t] = P(s' = t, o | s, a), rewards [a, s], terminal [s], observed [s], initial
            [s], discount, actions [a], observations [o]

Observations are one set for all actions, by their labels.  `transitions` and `kernel` are dense arrays, or
tuples of `scipy.sparse.csr_array` [s, t] by a, or by a and o.  In a file they are lists of entries instead:
`..._index` int64 [n, 3] (a, s, t) or [n, 4] (a, o, s, t), and `..._value` float64 [n].  Rows of terminal
states are empty.  No array holds Python objects: `numpy.load` reads the file without `allow_pickle`.
"""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.files import write_bytes


def mdp_fields(mdp: ArrayMDP, initial: FloatArray, *, dense: bool = False) -> dict[str, Any]:
    """An MDP and its start distribution [s] as arrays by name."""
    transitions: Any = mdp.transitions
    if dense:
        transitions = np.stack([matrix.toarray() for matrix in transitions])
    return {
        "transitions": transitions, "rewards": mdp.rewards, "applicable": mdp.applicable,
        "terminal": mdp.terminal, "initial": initial, "discount": mdp.discount, "actions": mdp.actions,
    }  # fmt: skip


def pomdp_fields(pomdp: ArrayPOMDP, *, dense: bool = False) -> dict[str, Any]:
    """A POMDP as arrays by name."""
    labels = tuple(dict.fromkeys(label for row in pomdp.observations for label in row))
    nothing = csr_array((pomdp.states, pomdp.states))
    kernel: Any = tuple(
        tuple(matrices[row.index(label)] if label in row else nothing for label in labels)
        for row, matrices in zip(pomdp.observations, pomdp.kernel, strict=True)
    )
    if dense:
        kernel = np.stack([np.stack([matrix.toarray() for matrix in row]) for row in kernel])
    return {
        "kernel": kernel, "rewards": pomdp.rewards, "terminal": pomdp.terminal, "observed": pomdp.observed,
        "initial": pomdp.initial, "discount": pomdp.discount, "actions": pomdp.actions,
        "observations": labels,
    }  # fmt: skip


def write_npz(fields: Mapping[str, Any], path: str | Path) -> None:
    """Write sparse fields as a file, which appears whole or not at all.

    Raises:
        ModelError: the file can't be written.
    """
    write_bytes(path, lambda: _npz(fields))


def _npz(fields: Mapping[str, Any]) -> bytes:
    arrays: dict[str, Any] = {}
    for name, content in fields.items():
        if name in ("transitions", "kernel"):
            arrays[f"{name}_index"], arrays[f"{name}_value"] = _entries(content)
        else:
            arrays[name] = np.asarray(content)
    stream = BytesIO()
    np.savez_compressed(stream, **arrays)
    return stream.getvalue()


def _entries(matrices: Any, outer: tuple[int, ...] = ()) -> tuple[IntArray, FloatArray]:
    """The entries of nested tuples of matrices: indices [n, depth + 2] and values [n]."""
    if not isinstance(matrices, tuple):
        cells = matrices.tocoo()
        indices = [np.full(len(cells.data), k, dtype=np.int64) for k in outer] + [cells.row, cells.col]
        return np.column_stack(indices).astype(np.int64), cells.data
    pieces = [_entries(part, (*outer, k)) for k, part in enumerate(matrices)]
    return np.concatenate([i for i, _ in pieces]), np.concatenate([v for _, v in pieces])
