"""Sampling from a factored model: many episodes at once, on arrays of value numbers.

Each next feature is drawn by inverting its cumulative distribution at a uniform number, parents of
synchronic arcs first.  One uniform number is drawn for each episode, feature and step whatever the
actions are, so that runs with one seed use common random numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import evaluate_states
from factored_polca.models.features import position
from factored_polca.symbolic import RowDiagram, SymbolicModel, Term
from factored_polca.symbolic.floats import as_float

States = npt.NDArray[np.int32]  # [episode, feature] value numbers
FloatArray = npt.NDArray[np.float64]


class Sampler:
    """Draws initial states, next states and rewards of a symbolic model."""

    def __init__(self, symbolic: SymbolicModel) -> None:
        self.symbolic = symbolic
        self._columns = symbolic.columns()
        self._cumulative: dict[int, tuple[RowDiagram, FloatArray]] = {}  # the row, which keeps its id

    def initial(
        self,
        episodes: int,
        generator: np.random.Generator,
        rows: Mapping[int, RowDiagram] | None = None,
    ) -> States:
        """States drawn from b0, or from another belief given as `rows` [episode, feature]."""
        count = len(self.symbolic.model.features)
        nowhere = np.zeros((episodes, count), dtype=np.int32)
        rows = self.symbolic.initial if rows is None else rows
        return self._draw(nowhere, rows, _parents_first(rows), generator)

    def step(
        self, states: States, actions: npt.NDArray[np.int64], generator: np.random.Generator
    ) -> tuple[States, FloatArray]:
        """Next states and rewards; where the action is -1 the state stays and the reward is 0."""
        uniform = generator.random(states.shape)
        following = states.copy()
        rewards = np.zeros(len(states))
        for number in np.unique(actions[actions >= 0]).tolist():
            mine = np.flatnonzero(actions == number)
            action = self.symbolic.actions[number]
            order = [i for i in reversed(action.elimination) if i in action.rows]
            drawn = self._draw(states[mine], action.rows, order, generator, uniform[mine])
            following[mine] = drawn
            rewards[mine] = self._rewards(action.sampled_rewards, states[mine], drawn)
        return following, rewards

    def observe(
        self,
        states: States,
        actions: npt.NDArray[np.int64],
        following: States,
        generator: np.random.Generator,
    ) -> npt.NDArray[np.int64]:
        """What the channels report after steps [episode, channel]; a channel not sensed its null value.

        One uniform number is drawn for each episode and channel, whatever the actions are.
        """
        channels = self.symbolic.model.observations
        uniform = generator.random((len(states), len(channels)))
        nulls = [position(channel.values, channel.null) or 0 for channel in channels]
        result = np.tile(np.array(nulls, dtype=np.int64), (len(states), 1))
        for number in np.unique(actions[actions >= 0]).tolist():
            mine = np.flatnonzero(actions == number)
            pairs = np.concatenate([states[mine], following[mine]], axis=1)
            for channel, row in self.symbolic.actions[number].observations.items():
                chosen = evaluate_states(row.diagram, pairs, self._columns).astype(np.int64)
                below = self._table(row)[chosen] <= uniform[mine, channel, None]
                result[mine, channel] = below.sum(axis=1)
        return result

    def expected_rewards(self, terms: Sequence[Term], states: States) -> FloatArray:
        """The sum of reward terms over present states alone, expectations taken [episode]."""
        total = np.zeros(len(states))
        for term in terms:
            values = np.array([as_float(value) for value in term.values])
            total += values[evaluate_states(term.diagram, states, self._columns).astype(np.int64)]
        return total

    def _draw(
        self,
        states: States,
        rows: Mapping[int, RowDiagram],
        order: Sequence[int],
        generator: np.random.Generator,
        uniform: FloatArray | None = None,
    ) -> States:
        count = states.shape[1]
        if uniform is None:
            uniform = generator.random(states.shape)
        pairs = np.concatenate([states, states], axis=1)
        for feature in order:
            row = rows[feature]
            chosen = evaluate_states(row.diagram, pairs, self._columns).astype(np.int64)
            table = self._table(row)
            below = table[chosen] <= uniform[:, feature, None]
            pairs[:, count + feature] = below.sum(axis=1).astype(np.int32)
        return np.ascontiguousarray(pairs[:, count:])

    def _table(self, row: RowDiagram) -> FloatArray:
        """Upper ends of the intervals of [0, 1) that stand for each value but the last possible one."""
        key = id(row)
        if key not in self._cumulative:
            table = np.cumsum([[float(q) for q in r] for r in row.rows], axis=1)
            for number, probabilities in enumerate(row.rows):
                last = max(v for v, q in enumerate(probabilities) if q)
                table[number, last:] = np.inf
            self._cumulative[key] = (row, table)
        return self._cumulative[key][1]

    def _rewards(self, terms: Sequence[Term], states: States, following: States) -> FloatArray:
        pairs = np.concatenate([states, following], axis=1)
        total = np.zeros(len(states))
        for term in terms:
            values = np.array([as_float(value) for value in term.values])
            total += values[evaluate_states(term.diagram, pairs, self._columns).astype(np.int64)]
        return total

    def terminal(self, states: States) -> npt.NDArray[np.bool_]:
        """Which states are terminal."""
        return evaluate_states(self.symbolic.terminal, states, self._columns).astype(bool)


def _parents_first(rows: Mapping[int, RowDiagram]) -> list[int]:
    import networkx as nx

    graph = nx.DiGraph()
    graph.add_nodes_from(rows)
    graph.add_edges_from((parent, i) for i, row in rows.items() for parent in row.parents_next)
    return list(nx.lexicographical_topological_sort(graph))
