"""A Markov decision process over numbered states in exact rationals, and its abstract actions.

An *abstract action* stands for one primitive action at each state where it applies.  For the child h
of a task, with the policy pi_h: state -> primitive, it is the paper's policy-contingent action

    T(s, h, s') = T(s, pi_h(s), s'),    R(s, h) = R(s, pi_h(s)):

one step, not the whole run of the child (Pineau, Gordon & Thrun 2003, section 4).  It does not apply
where pi_h is undefined: where h has ended, or has no applicable action itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.models.features import Feature
from factored_polca.models.scalars import Value

Row: TypeAlias = dict[int, Fraction]
"""Next state -> positive probability."""


@dataclass(frozen=True)
class ExactMDP:
    """An MDP over numbered states in exact rationals; axes are a (action), s (state).

    Where an action does not apply, and at terminal states, its row is empty and its reward 0.
    """

    features: tuple[Feature, ...]
    state_values: tuple[tuple[Value, ...], ...]  # [s], one value for each feature
    actions: tuple[str, ...]
    rows: tuple[tuple[Row, ...], ...]  # [a][s]
    rewards: tuple[tuple[Fraction, ...], ...]  # [a][s]
    applicable: tuple[tuple[bool, ...], ...]  # [a][s], False at terminal states
    terminal: tuple[bool, ...]  # [s]
    initial: tuple[Fraction, ...]  # [s], sums to 1
    discount: Fraction

    @property
    def states(self) -> int:
        """The number of states."""
        return len(self.state_values)

    def index(self, values: Sequence[Value]) -> int:
        """The number of the state with these values, one for each feature.

        Raises:
            ValueError: too few or too many values, or one that the feature does not have.
        """
        if len(values) != len(self.features):
            raise ValueError(f"{len(values)} values for {len(self.features)} features")
        number = 0
        for feature, value in zip(self.features, values, strict=True):
            digit = feature.index(value)
            if digit is None:
                raise ValueError(f"{value!r} is no value of {feature.name!r}: {feature.values}")
            number = number * len(feature.values) + digit
        return number

    def restrict(self, actions: Sequence[str]) -> ExactMDP:
        """The MDP with only `actions`, in this order.

        Raises:
            KeyError: there is no such action; the message lists those there are.
        """
        for name in actions:
            if name not in self.actions:
                raise KeyError(f"no action {name!r}; there are {', '.join(self.actions)}")
        chosen = [self.actions.index(name) for name in actions]
        return replace(
            self,
            actions=tuple(actions),
            rows=tuple(self.rows[a] for a in chosen),
            rewards=tuple(self.rewards[a] for a in chosen),
            applicable=tuple(self.applicable[a] for a in chosen),
        )

    def with_abstract_actions(self, policies: Mapping[str, Sequence[int]]) -> ExactMDP:
        """The MDP with one more action for each policy, after its own.

        `policies[name][s]` is the number of the action of this MDP that `name` stands for at s, or
        -1 where `name` does not apply.  What it says at terminal states is not read.

        Raises:
            ValueError: a policy of another length, a name in use, or an action that does not apply.
        """
        result = self
        for name, policy in policies.items():
            result = _add_abstract_action(result, self, name, policy)
        return result

    def to_arrays(self) -> ArrayMDP:
        """The same MDP in floating point."""
        return ArrayMDP(
            actions=self.actions,
            transitions=tuple(_sparse(rows) for rows in self.rows),
            rewards=np.array(self.rewards, dtype=np.float64).reshape(len(self.actions), self.states),
            applicable=np.array(self.applicable, dtype=np.bool_).reshape(len(self.actions), self.states),
            terminal=np.array(self.terminal, dtype=np.bool_),
            discount=float(self.discount),
        )


def _sparse(rows: Sequence[Row]) -> csr_array:
    starts = np.cumsum([0, *(len(row) for row in rows)])
    columns = np.array([t for row in rows for t in sorted(row)], dtype=np.int64)
    chances = np.array([float(row[t]) for row in rows for t in sorted(row)], dtype=np.float64)
    return csr_array((chances, columns, starts), shape=(len(rows), len(rows)))


def _add_abstract_action(mdp: ExactMDP, source: ExactMDP, name: str, policy: Sequence[int]) -> ExactMDP:
    if len(policy) != source.states:
        raise ValueError(f"the policy of {name!r} has {len(policy)} entries for {source.states} states")
    if name in mdp.actions:
        raise ValueError(f"{name!r} is already an action; an abstract action needs a name of its own")
    rows: list[Row] = []
    rewards: list[Fraction] = []
    applicable: list[bool] = []
    for s, a in enumerate(policy):
        applies = a >= 0 and not source.terminal[s]
        if applies and not source.applicable[a][s]:
            raise ValueError(
                f"{name!r} stands for {source.actions[a]!r} at state {s} {source.state_values[s]}, where "
                "that does not apply; write -1 where the abstract action has no applicable action"
            )
        rows.append(source.rows[a][s] if applies else {})
        rewards.append(source.rewards[a][s] if applies else Fraction(0))
        applicable.append(applies)
    return replace(
        mdp,
        actions=(*mdp.actions, name),
        rows=(*mdp.rows, tuple(rows)),
        rewards=(*mdp.rewards, tuple(rewards)),
        applicable=(*mdp.applicable, tuple(applicable)),
    )
