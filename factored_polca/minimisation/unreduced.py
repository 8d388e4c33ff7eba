"""The flat model as arrays, read off its diagrams without minimising: every state apart.

For each action a the successors of all states are listed one by one (`expansion`):

    K_a(x; x', o) = prod_i P_a(x_i' | x, x') * prod_j P_a(o_j | x', x),
    R_a(x)        = sum of the compiled terms, expectations over x' and o taken.

States are numbered in ascending order of their value numbers, the last feature running fastest, as in
`factored_polca.explicit.enumeration`; of all states, or of those that can be reached from the initial
belief's support: then breadth-first, so that the full product is never listed.  The observations of an
action are the joint ones that occur under it, in ascending order of the channels' value numbers.
What is seen of a state beside them, `observed`, are its features flagged so; in a fully observed
model all of it.

Floats: each entry is a product of as many rounded probabilities as there are variables.
`factored_polca.explicit.exact_pomdp` is the slow and exact reading that this must agree with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.arrays import ArrayMDP, BoolArray, SparseMatrix
from factored_polca.explicit.exact_pomdp import observation_label
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.minimisation.expansion import DoesNotApply, Expansion, Piece, TooMany
from factored_polca.minimisation.outcomes import (
    Draw,
    FloatArray,
    Int32Array,
    Int64Array,
    Numbering,
    make_draw,
    outcomes,
    parents_first,
)
from factored_polca.models import Fault, LimitReached, ModelError
from factored_polca.models.features import position
from factored_polca.symbolic import SymbolicAction, SymbolicModel
from factored_polca.symbolic.floats import as_float

MAXIMUM_STATES: Final = 1_000_000
"""Largest number of states that is listed unless a caller says otherwise."""

MAXIMUM_OBSERVATIONS: Final = 1_000
"""Largest number of joint observations of one action, unless a caller says otherwise."""

MAXIMUM_ENTRIES: Final = 20_000_000
"""Largest number of entries (s, t, o) of all actions together; they take 32 bytes each."""


@dataclass(frozen=True)
class Unreduced:
    """A flat POMDP and what its state numbers mean."""

    pomdp: ArrayPOMDP
    states: Int32Array  # [s, feature] value numbers


@dataclass
class _Entries:
    """The entries of one action, in pieces [k]: numbers of x, x' and o, and the probability."""

    action: SymbolicAction
    draws: list[Draw]
    sensed: list[int]  # the channels that are sensed, ascending
    seen: Numbering  # their joint values
    source: list[Int32Array] = field(default_factory=list)
    target: list[Int32Array] = field(default_factory=list)
    observation: list[Int64Array] = field(default_factory=list)
    chance: list[FloatArray] = field(default_factory=list)


@dataclass(frozen=True)
class _Limits:
    states: int
    observations: int
    entries: int


class _Listing:
    """States and entries as they are found.

    `total` refuses actions that do not apply everywhere; `reachable` lists no other states.
    """

    def __init__(
        self, symbolic: SymbolicModel, limits: _Limits, *, total: bool = False, reachable: bool = False
    ) -> None:
        self.symbolic, self.limits, self.total, self.reachable = symbolic, limits, total, reachable
        self.model = symbolic.model
        self.features = len(self.model.features)
        self.columns = symbolic.columns()
        self.product = Numbering([len(f.values) for f in self.model.features])
        self.expansion = Expansion(symbolic, (limits.states, limits.entries), reachable=reachable)
        self.entries = [self._prepare(action) for action in symbolic.actions]
        self.count = 0

    def _prepare(self, action: SymbolicAction) -> _Entries:
        n, sensed = self.features, sorted(action.observations)
        draws = [make_draw(action.rows[i], n + i) for i in reversed(action.elimination) if i in action.rows]
        draws += [make_draw(action.observations[j], 2 * n + j) for j in sensed]
        sizes = [len(self.model.observations[j].values) for j in sensed]
        return _Entries(action, draws, sensed, Numbering(sizes))

    def number(self, digits: Int32Array) -> Int64Array:
        """The number of each state [k, feature]."""
        if not self.reachable:  # every state has its number already
            return self.product.encode(digits)[:, 0]
        return self.expansion.add(digits)

    def initial(self) -> tuple[Int64Array, FloatArray]:
        """The states of the initial belief's support and their probabilities."""
        n, rows = self.features, self.symbolic.initial
        draws = [make_draw(rows[i], n + i) for i in parents_first(rows)]
        nowhere = np.zeros((1, 2 * n), dtype=np.int32)
        found = [
            (self.number(table[:, n:]), chance)
            for _, table, chance in outcomes(draws, self.columns, nowhere)
        ]
        return np.concatenate([s for s, _ in found]), np.concatenate([q for _, q in found])

    def all_states(self) -> Int32Array:
        """All states of the product [s, feature]."""
        if self.product.count > self.limits.states:
            raise LimitReached(
                f"{self.model.name}: {self.product.count} states are more than the {self.limits.states} "
                "that may be listed; raise maximum_states, list the reachable ones, or minimise the model",
                stage="listing the states",
            )
        return self.product.decode(np.arange(self.product.count)[:, None])

    def expand(self) -> None:
        """Record the entries of all states, and of those that they lead to."""
        channels = self.model.observations
        nulls = [position(channel.values, channel.null) or 0 for channel in channels]
        draws = [entries.draws for entries in self.entries]
        try:
            for piece in self.expansion.pieces(draws, nulls, total=self.total):
                self._record(piece)
                self._count(len(piece.chance))
        except DoesNotApply as error:
            raise self._partial(error) from None
        except TooMany as error:
            if error.what == "entries":
                self._count(self.limits.entries + 1)
            raise LimitReached(
                f"{self.model.name}: more than {self.limits.states} states can be reached; raise "
                "maximum_states, or minimise the model",
                stage="listing the states",
            ) from None

    def _record(self, piece: Piece) -> None:
        by_action = np.argsort(piece.action, kind="stable")
        bounds = np.searchsorted(piece.action[by_action], np.arange(len(self.entries) + 1)).tolist()
        for entries, low, high in zip(self.entries, bounds[:-1], bounds[1:], strict=True):
            if low < high:
                mine = by_action[low:high]
                entries.source.append(piece.source[mine])
                entries.target.append(piece.target[mine])
                entries.chance.append(piece.chance[mine])
                entries.observation.append(self._observe(entries, piece.seen[mine]))

    def terminal(self, digits: Int32Array) -> BoolArray:
        """Which states are terminal."""
        return evaluate_states(self.symbolic.terminal, digits, self.columns).astype(np.bool_)

    def _partial(self, error: DoesNotApply) -> ModelError:
        name = self.symbolic.actions[error.action].name
        by_level = [error.digits[column % self.features] for column in self.columns[: 2 * self.features]]
        fault = Fault(
            f"{name!r} does not apply at {self.symbolic.state_text(by_level)}",
            ("actions", name, "applicable"),
            "in a POMDP actions apply everywhere: state what happens where it has no effect",
        )
        return ModelError([fault])

    def _observe(self, entries: _Entries, seen: Int32Array) -> Int64Array:
        numbers = entries.seen.number(seen[:, entries.sensed])
        if len(entries.seen) > self.limits.observations:
            channels = [self.model.observations[j] for j in entries.sensed]
            listed = ", ".join(f"{c.name} ({len(c.values)} values)" for c in channels)
            raise LimitReached(
                f"action {entries.action.name!r} of {self.model.name}: more than "
                f"{self.limits.observations} joint observations of {listed}; raise "
                "maximum_observations, or let actions sense fewer channels or coarser values",
                stage="listing the observations",
            )
        return numbers

    def _count(self, more: int) -> None:
        self.count += more
        if self.count > self.limits.entries:
            raise LimitReached(
                f"{self.model.name}: more than {self.limits.entries} triples of state, next state and "
                "observation have a positive probability; raise maximum_entries, or minimise the model",
                stage="listing the transitions",
            )


def unreduced(
    symbolic: SymbolicModel,
    *,
    maximum_states: int = MAXIMUM_STATES,
    maximum_observations: int = MAXIMUM_OBSERVATIONS,
    maximum_entries: int = MAXIMUM_ENTRIES,
    reachable: bool = False,
) -> Unreduced:
    """The flat POMDP of a model, with the meaning of its state numbers.

    Args:
        maximum_states: how many states may be listed.
        maximum_observations: how many joint observations an action may have.
        maximum_entries: how many triples (x, x', o) may have a positive probability, over all actions.
        reachable: list only the states that the initial belief's support leads to.

    Raises:
        LimitReached: more states, observations or transitions than allowed.
        ModelError: an action that does not apply everywhere, in a fully observed model.
    """
    limits = _Limits(maximum_states, maximum_observations, maximum_entries)
    listing = _Listing(symbolic, limits, total=True, reachable=reachable)
    support, weights = _list(listing)
    states, place = _ordered(listing)
    model, count = symbolic.model, len(states)
    initial = np.zeros(count)
    np.add.at(initial, place[support], weights)
    terminal = listing.terminal(states)
    read = [_matrices(listing, entries, place) for entries in listing.entries]
    seen = [i for i, feature in enumerate(model.features) if feature.observed]
    observed = np.arange(count)
    if model.observability == "partial":
        by_seen = Numbering([len(model.features[i].values) for i in seen])
        numbers = by_seen.number(states[:, seen])
        observed = by_seen.ranks()[numbers]
    pomdp = array_pomdp(
        [matrices for _, matrices in read],
        np.array([_rewards(listing, action, states, ~terminal) for action in symbolic.actions]),
        initial,
        float(model.discount),
        actions=[action.name for action in symbolic.actions],
        observations=[labels for labels, _ in read],
        terminal=terminal,
        observed=observed,
    )
    return Unreduced(pomdp, states)


def unreduced_pomdp(
    symbolic: SymbolicModel,
    *,
    maximum_states: int = MAXIMUM_STATES,
    maximum_observations: int = MAXIMUM_OBSERVATIONS,
    maximum_entries: int = MAXIMUM_ENTRIES,
    reachable: bool = False,
) -> ArrayPOMDP:
    """The flat POMDP of a model; see `unreduced`."""
    return unreduced(
        symbolic,
        maximum_states=maximum_states,
        maximum_observations=maximum_observations,
        maximum_entries=maximum_entries,
        reachable=reachable,
    ).pomdp


def unreduced_mdp(
    symbolic: SymbolicModel,
    *,
    maximum_states: int = MAXIMUM_STATES,
    maximum_entries: int = MAXIMUM_ENTRIES,
) -> ArrayMDP:
    """The flat MDP of a model whose state is seen, over all its states.

    Raises:
        LimitReached: more states or transitions than allowed.
    """
    listing = _Listing(symbolic, _Limits(maximum_states, MAXIMUM_OBSERVATIONS, maximum_entries))
    for entries in listing.entries:  # observations do not matter
        entries.draws = [draw for draw in entries.draws if draw.column < 2 * listing.features]
        entries.sensed, entries.seen = [], Numbering([])
    _list(listing)
    states, place = _ordered(listing)
    terminal = listing.terminal(states)
    applicable = np.array(
        [evaluate_states(a.app, states, listing.columns).astype(np.bool_) for a in symbolic.actions]
    )
    rewards = [
        _rewards(listing, action, states, where)
        for action, where in zip(symbolic.actions, applicable, strict=True)
    ]
    return ArrayMDP(
        tuple(action.name for action in symbolic.actions),
        tuple(_matrices(listing, entries, place)[1][0] for entries in listing.entries),
        np.array(rewards),
        applicable,
        terminal,
        float(symbolic.model.discount),
    )


def _list(listing: _Listing) -> tuple[Int64Array, FloatArray]:
    """List the states and entries; the support of the initial belief and its weights."""
    if not listing.reachable:
        listing.all_states()  # not too many
    initial = listing.initial()
    listing.expand()
    return initial


def _ordered(listing: _Listing) -> tuple[Int32Array, Int64Array]:
    """The states in ascending order [s, feature], and the place there of each number."""
    if not listing.reachable:
        states = listing.all_states()
        return states, np.arange(len(states))
    order = np.lexsort(listing.expansion.states.T[::-1])
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    return listing.expansion.states[order], place


def _matrices(
    listing: _Listing, entries: _Entries, place: Int64Array
) -> tuple[list[str], list[SparseMatrix]]:
    """The labels of an action's observations and the matrix [s, t] of each."""
    channels, count = listing.model.observations, len(place)
    values = [position(channel.values, channel.null) or 0 for channel in channels]
    if len(entries.seen) == 0:  # no state is live: nothing is ever observed
        entries.seen.number(np.zeros((1, len(entries.sensed)), dtype=np.int32))
        values = [0] * len(channels)
    order = np.argsort(entries.seen.ranks())
    labels = []
    for tuple_ in entries.seen.tuples()[order].tolist():
        for j, value in zip(entries.sensed, tuple_, strict=True):
            values[j] = value
        labels.append(
            observation_label(channels, [c.values[v] for c, v in zip(channels, values, strict=True)])
        )
    source, target = place[_joined(entries.source)], place[_joined(entries.target)]
    observation = entries.seen.ranks()[_joined(entries.observation)]
    chance = np.concatenate([*entries.chance, np.empty(0)])
    by_row = np.argsort((observation * count + source) * count + target)
    bounds = np.searchsorted(observation[by_row], np.arange(len(labels) + 1))
    matrices: list[SparseMatrix] = []
    for low, high in pairwise(bounds.tolist()):
        part = by_row[low:high]
        starts = np.concatenate([[0], np.cumsum(np.bincount(source[part], minlength=count))])
        matrices.append(csr_array((chance[part], target[part], starts), shape=(count, count)))
    return labels, matrices


def _joined(pieces: Sequence[Int32Array] | Sequence[Int64Array]) -> Int64Array:
    return np.concatenate([*pieces, np.empty(0, dtype=np.int64)])


def _rewards(listing: _Listing, action: SymbolicAction, states: Int32Array, where: BoolArray) -> FloatArray:
    """The expected reward of each state [s], 0 outside `where`."""
    total = np.zeros(len(states))
    for term in action.rewards:
        values = np.array([as_float(value, action.name) for value in term.values])
        total += values[evaluate_states(term.diagram, states, listing.columns).astype(np.int64)]
    total[~where] = 0
    return total
