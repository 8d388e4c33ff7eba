"""Arrays as Cassandra's format needs them: transitions T and observations O apart, no terminal state.

The joint kernel K_a(s; t, o) of an `ArrayPOMDP` need not be T_a(s, t) O_a(t, o).  Where the chances
K_a(s; t, o) / sum over o of K_a(s; t, o) differ from one s to another, t is *split* into pairs (t, o), one
for each o that may come with t:

    T_a((s, .), (t, o)) = K_a(s; t, o),     O((t, o), o) = 1 after every action.

Pairs of one t have the same future, so that any of them can stand for t in the initial belief; the first
does.  The other states stay as they are.

Observations are padded: one set for all actions, by their names.  Where states are told apart by what is
seen of them (`observed`, y) and y is news, which the last y and the action do not foretell, it becomes part
of the observation: o is then (o, y).  There is no observation before the first action, so the start must
foretell its y; `with_first_step` puts a step before it that shows y.  If every state is seen the process is
an MDP and has no observations.  A single observation is padded to two, the second of which, `never`, never
comes: pomdp-solve does not take files with one.

Terminal states are one state `end` that is never left, with reward 0 for every action and an observation
of its own, `ended`: its value is 0, and that it was reached is seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.sparse import coo_array, csr_array, vstack

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import Fault, ModelError

TOLERANCE: Final = 1e-12
"""Chances of an observation that differ by less are taken to be equal: they come from rounded products."""
END: Final = -1
"""In `FactoredArrays.origin`: the state that stands for all terminal ones."""
ENDED: Final = "ended"
"""The observation of the end."""
NEVER: Final = "never"
"""The observation beside a single one."""


@dataclass(frozen=True)
class FactoredArrays:
    """A POMDP with T and O apart, or an MDP (`observations` None); axes s, t: states that are written."""

    actions: tuple[str, ...]
    labels: tuple[str, ...]  # [o]
    transitions: tuple[SparseMatrix, ...]  # [a] CSR [s, t]
    observations: tuple[SparseMatrix, ...] | None  # [a] CSR [t, o]
    rewards: FloatArray  # [a, s]
    initial: FloatArray  # [s]
    origin: IntArray  # [s] the state it stands for, or `END`
    symbol: IntArray  # [s] the observation of a pair, -1 of a state that is not split
    first: IntArray  # [s of the original] the state that stands for it in beliefs
    discount: float

    @property
    def states(self) -> int:
        """The number of states."""
        return len(self.origin)


@dataclass(frozen=True)
class _Entries:
    """The kernel of one action at states that go on: parallel arrays."""

    s: IntArray
    t: IntArray
    o: IntArray
    chance: FloatArray


def factored(pomdp: ArrayPOMDP, *, as_mdp: bool = True, start_told: bool = True) -> FactoredArrays:
    """`pomdp` with transitions and observations apart.

    Without `as_mdp` there are observations even if every state is seen.  Without `start_told` it does not
    matter what is seen at the start.

    Raises:
        ModelError: an action that does not apply everywhere, or something that is seen of the state and
            not foretold at the start.
    """
    _require_total(pomdp)
    live = np.flatnonzero(~pomdp.terminal)
    seen = pomdp.observed[live]
    mdp = as_mdp and len(np.unique(seen)) == len(live) and len(live) > 1
    entries, labels = _entries(pomdp, mdp, start_told)
    if not mdp and len(labels) == 1:
        labels = (*labels, NEVER if labels != (NEVER,) else f"{NEVER}_2")
    split = np.zeros(pomdp.states, dtype=np.bool_)
    if not mdp:
        for part in entries:
            split |= _uneven(part, pomdp.states, pomdp.terminal)
    origin, symbol = _states(entries, split, pomdp)
    place = {pair: k for k, pair in enumerate(zip(origin.tolist(), symbol.tolist(), strict=True))}
    first = np.full(pomdp.states, len(origin) - 1, dtype=np.int64)  # of terminal states: the end
    alive = np.flatnonzero(origin >= 0)[::-1]
    first[origin[alive]] = alive
    transitions = tuple(_transitions(part, split, origin, first, place) for part in entries)
    observations = None
    if not mdp:
        observations = tuple(
            _observations(part, split, origin, symbol, len(labels), pomdp.terminal) for part in entries
        )
    rewards = np.where(origin >= 0, pomdp.rewards[:, origin], 0.0)
    initial = np.zeros(len(origin))
    np.add.at(initial, first, pomdp.initial)
    return FactoredArrays(
        pomdp.actions, labels, transitions, observations, rewards, initial, origin, symbol, first,
        pomdp.discount,
    )  # fmt: skip


def with_first_step(pomdp: ArrayPOMDP) -> ArrayPOMDP:
    """`pomdp` begun one step earlier, in one more state, the last.

    There every action has the reward 0 and leads to b0, so that what is seen of the state at the start is
    seen after it.  All values at the start are those of `pomdp` times the discount.  The observation on the
    way there tells nothing, so that `factored` splits states whose observation tells something.
    """
    count = pomdp.states
    start = csr_array(pomdp.initial[None, :])
    empty = csr_array((1, count))

    def longer(matrix: SparseMatrix, row: SparseMatrix) -> SparseMatrix:
        taller = vstack([matrix, row], format="csr")
        return csr_array((taller.data, taller.indices, taller.indptr), shape=(count + 1, count + 1))

    kernel = tuple(
        tuple(longer(matrix, start if o == 0 else empty) for o, matrix in enumerate(matrices))
        for matrices in pomdp.kernel
    )
    return ArrayPOMDP(
        pomdp.actions,
        pomdp.observations,
        kernel,
        np.pad(pomdp.rewards, ((0, 0), (0, 1))),
        np.append(pomdp.terminal, False),
        np.append(pomdp.observed, pomdp.observed.max() + 1),
        np.append(np.zeros(count), 1.0),
        pomdp.discount,
    )


def seen_label(label: str, seen: int) -> str:
    """The label of an observation with what is seen of the state."""
    return f"{label},seen{seen}"


def _require_total(pomdp: ArrayPOMDP) -> None:
    for name, matrices in zip(pomdp.actions, pomdp.kernel, strict=True):
        sums = sum(np.asarray(matrix.sum(axis=1)) for matrix in matrices)
        if np.any((sums == 0) & ~pomdp.terminal):
            raise ModelError([Fault(f"action {name!r} does not apply everywhere", ("actions", name),
                                    "say what happens elsewhere: this format needs it")])  # fmt: skip


def _entries(pomdp: ArrayPOMDP, mdp: bool, start_told: bool) -> tuple[list[_Entries], tuple[str, ...]]:
    """The kernels with the numbers of padded observations, and these observations' labels."""
    names = tuple(dict.fromkeys(label for row in pomdp.observations for label in row))
    number = {name: k for k, name in enumerate(names)}
    kinds = int(pomdp.observed.max()) + 1
    news = not mdp and _is_news(pomdp, start_told)
    found = []
    for row, matrices in zip(pomdp.observations, pomdp.kernel, strict=True):
        pieces = [matrix.tocoo() for matrix in matrices]
        counts = [len(piece.data) for piece in pieces]
        s = np.concatenate([piece.row for piece in pieces]).astype(np.int64)
        t = np.concatenate([piece.col for piece in pieces]).astype(np.int64)
        o = np.repeat(np.array([number[label] for label in row], dtype=np.int64), counts)
        if news:
            o = o * kinds + pomdp.observed[t]
        chance = np.concatenate([piece.data for piece in pieces])
        kept = chance > 0
        found.append(_Entries(s[kept], t[kept], o[kept], chance[kept]))
    ended = pomdp.terminal.any()
    used = np.unique(np.concatenate([part.o[~pomdp.terminal[part.t]] for part in found]))
    if not len(used):
        used = np.zeros(1, dtype=np.int64)
    labels = [seen_label(names[k // kinds], k % kinds) if news else names[k] for k in used.tolist()]
    labels += [ENDED] if ended else []
    renumbered = []
    for part in found:
        o = np.where(pomdp.terminal[part.t], len(used), np.searchsorted(used, part.o))
        renumbered.append(_Entries(part.s, part.t, o, part.chance))
    return renumbered, tuple(labels)


def _is_news(pomdp: ArrayPOMDP, start_told: bool) -> bool:
    """Whether what is seen of the state says more than the action and what was seen before.

    Raises:
        ModelError: it does at the start, where there is no observation.
    """
    begun = (pomdp.initial > 0) & ~pomdp.terminal
    if start_told and len(np.unique(pomdp.observed[begun])) > 1:
        raise ModelError([Fault(
            "part of the state is seen, and the start leaves open what is seen first", ("initial",),
            "this format has no observation before the first action: give the observed features one "
            "value each at the start, or begin with a step that shows it (--first-step)",
        )])  # fmt: skip
    for matrices in pomdp.kernel:
        pairs = []
        for matrix in matrices:
            cells = matrix.tocoo()
            kept = ~pomdp.terminal[cells.col] & (cells.data > 0)
            pairs.append(
                np.column_stack([pomdp.observed[cells.row[kept]], pomdp.observed[cells.col[kept]]])
            )
        followers = np.unique(np.concatenate(pairs), axis=0)
        if len(np.unique(followers[:, 0])) < len(followers):
            return True
    return False


def _uneven(part: _Entries, states: int, terminal: BoolArray) -> BoolArray:
    """The next states [t] whose observation depends on the state before."""
    live = ~terminal[part.t]
    s, t, o, chance = part.s[live], part.t[live], part.o[live], part.chance[live]
    result = np.zeros(states, dtype=np.bool_)
    if not len(s):
        return result
    _, move = np.unique(s * states + t, return_inverse=True)
    totals = np.bincount(move, weights=chance)
    share = chance / totals[move]
    sources = np.bincount(np.unique(s * states + t) % states, minlength=states)  # [t] moves that lead there
    keys, group = np.unique(t * (int(o.max()) + 1) + o, return_inverse=True)
    least, most = np.full(len(keys), np.inf), np.full(len(keys), -np.inf)
    np.minimum.at(least, group, share)
    np.maximum.at(most, group, share)
    target = keys // (int(o.max()) + 1)
    uneven = (most - least > TOLERANCE) | (np.bincount(group) < sources[target])
    result[target[uneven]] = True
    return result


def _states(entries: Sequence[_Entries], split: BoolArray, pomdp: ArrayPOMDP) -> tuple[IntArray, IntArray]:
    """The states that are written: the state each stands for, and its observation if it is a pair."""
    whole = np.flatnonzero(~split & ~pomdp.terminal)
    pieces = [np.column_stack([whole, np.full(len(whole), -1)])]
    for part in entries:
        mine = split[part.t]
        pieces.append(np.column_stack([part.t[mine], part.o[mine]]))
    pairs = np.unique(np.concatenate(pieces), axis=0)
    if pomdp.terminal.any():
        pairs = np.concatenate([pairs, np.array([[END, -1]])])
    return pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)


def _transitions(
    part: _Entries,
    split: BoolArray,
    origin: IntArray,
    first: IntArray,
    place: dict[tuple[int, int], int],
) -> SparseMatrix:
    """T of one action: every copy of a state has the row of that state."""
    target = first[part.t].copy()
    paired = np.flatnonzero(split[part.t])
    target[paired] = [
        place[pair] for pair in zip(part.t[paired].tolist(), part.o[paired].tolist(), strict=True)
    ]
    shape = (len(split), len(origin))
    rows = csr_array(coo_array((part.chance, (part.s, target)), shape=shape))
    rows.sum_duplicates()
    copies: Any = rows[origin[origin >= 0]]
    if origin[-1] == END:
        stay = csr_array(([1.0], ([0], [len(origin) - 1])), shape=(1, len(origin)))
        copies = vstack([copies, stay], format="csr")
    return copies


def _observations(
    part: _Entries,
    split: BoolArray,
    origin: IntArray,
    symbol: IntArray,
    labels: int,
    terminal: BoolArray,
) -> SparseMatrix:
    """O of one action; a state that the action does not lead to gets the first observation."""
    mine = ~terminal[part.t] & ~split[part.t]
    shape = (len(split), labels)
    sums = csr_array(coo_array((part.chance[mine], (part.t[mine], part.o[mine])), shape=shape))
    reached = np.asarray(sums.sum(axis=1))
    rates = sums.tocoo()
    whole = np.flatnonzero((origin >= 0) & (symbol < 0))
    back = np.full(len(split), -1, dtype=np.int64)
    back[origin[whole]] = whole
    idle = whole[reached[origin[whole]] == 0]
    pairs = np.flatnonzero(symbol >= 0)
    end = np.flatnonzero(origin == END)
    row = np.concatenate([back[rates.row], idle, pairs, end])
    column = np.concatenate([
        rates.col, np.zeros(len(idle), dtype=np.int64), symbol[pairs], np.full(len(end), labels - 1)
    ])  # fmt: skip
    ones = np.ones(len(idle) + len(pairs) + len(end))
    data = np.concatenate([rates.data / reached[rates.row], ones])
    return csr_array(coo_array((data, (row, column)), shape=(len(origin), labels)))
