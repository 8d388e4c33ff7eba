"""Policies without a hierarchy, which speak of listed states, run on the original model.

A state that was drawn has a number in the list; what the policy may know of it is what is seen of it (`y`)
and what the channels report, which is one of the listed joint observations of its action.  Beliefs [s] are
tracked by the listed kernel, b' ~ b K_a(.; ., o), narrowed to y and to the episode going on; a policy graph
has a node in place of a belief.
"""

from __future__ import annotations

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import IntArray
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.exact_pomdp import observation_label
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.models import ModelError
from factored_polca.simulation.sampler import States


class ListedStates:
    """The numbers of states [episode, feature] in the list that a policy is for."""

    def __init__(self, policy: FlatPolicy) -> None:
        flat = policy.flat
        sizes = [len(feature.values) for feature in flat.symbolic.model.features]
        weights = [1]
        for size in reversed(sizes[1:]):
            weights.append(weights[-1] * size)
        self.weights = np.array(
            weights[::-1], dtype=object if weights[-1] * sizes[0] >= 2**62 else np.int64
        )
        codes = flat.states.astype(self.weights.dtype) @ self.weights
        self.order = np.argsort(codes, kind="stable")
        self.codes = codes[self.order]

    def number(self, states: States) -> IntArray:
        """The number of each state.

        Raises:
            ModelError: a state that is not listed.
        """
        codes = states.astype(self.weights.dtype) @ self.weights
        place = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
        if (self.codes[place] != codes).any():
            raise ModelError("a state was reached that the policy's list of states lacks")
        numbers: IntArray = self.order[place].astype(np.int64)
        return numbers


class ListedActions:
    """What a policy of listed states does, its state seen."""

    def __init__(self, policy: FlatPolicy) -> None:
        if not isinstance(policy.policy, StatePolicy):
            raise ModelError("the state is seen, and the policy is one over beliefs")
        self.policy, self.listed = policy.policy, ListedStates(policy)

    def __call__(self, states: States, step: int) -> IntArray:
        return self.policy.choose(self.listed.number(states), step)


class ListedMinds:
    """Beliefs, or nodes of a policy graph, in the episodes of a chunk (see `belief_runs.Minds`)."""

    resets = 0

    def __init__(self, policy: FlatPolicy, count: int) -> None:
        self.flat, self.policy, self.step = policy.flat, policy.policy, 0
        self.pomdp = policy.flat.pomdp
        self.listed = ListedStates(policy)
        self.live = ~self.pomdp.terminal
        self.nodes = np.full(count, -1, dtype=np.int64)
        wide = 0 if isinstance(self.policy, (PolicyGraph, StatePolicy)) else self.pomdp.states
        self.beliefs = np.zeros((count, wide))
        self.numbers = np.zeros(count, dtype=np.int64)
        self.labels = [{name: k for k, name in enumerate(names)} for names in self.pomdp.observations]

    def begin(self, mine: IntArray, states: States) -> None:
        self.numbers[mine] = self.listed.number(states)
        if isinstance(self.policy, PolicyGraph):
            self.nodes[mine] = self.policy.start[self.pomdp.observed[self.numbers[mine]]]
        elif self.beliefs.shape[1]:
            self.beliefs[mine] = self.pomdp.initial
            self.narrow(mine)

    def choose(self, mine: IntArray) -> IntArray:
        step, self.step = self.step, self.step + 1
        if isinstance(self.policy, PolicyGraph):
            nodes = self.nodes[mine]
            return np.where(nodes >= 0, self.policy.actions[nodes], -1)
        if isinstance(self.policy, StatePolicy):
            return self.policy.choose(self.numbers[mine], step)
        assert isinstance(self.policy, (AlphaVectors, StagedVectors, EntropyPolicy))
        return self.policy.choose(self.beliefs[mine], step)

    def learn(self, mine: IntArray, actions: IntArray, values: IntArray, following: States) -> None:
        self.numbers[mine] = self.listed.number(following)
        if isinstance(self.policy, StatePolicy):
            return
        seen = self.pomdp.observed[self.numbers[mine]]
        keys = np.concatenate([actions[:, None], values], axis=1)
        distinct, place = np.unique(keys, axis=0, return_inverse=True)
        for k, (action, *row) in enumerate(distinct.tolist()):
            told = np.flatnonzero(place.reshape(-1) == k)
            observation = self.observation(action, row)
            here = mine[told]
            if isinstance(self.policy, PolicyGraph):
                before = self.nodes[here]
                for node in np.unique(before).tolist():
                    same = before == node
                    table = self.policy.successors[node]
                    self.nodes[here[same]] = table[observation, seen[told[same]]]
            else:
                self.beliefs[here] = self.beliefs[here] @ self.pomdp.kernel[action][observation]
        if not isinstance(self.policy, PolicyGraph):
            self.narrow(mine)

    def observation(self, action: int, row: list[int]) -> int:
        """The number of a joint observation [channel], null where not sensed, after an action."""
        channels = self.flat.symbolic.model.observations
        values = [channel.values[v] for channel, v in zip(channels, row, strict=True)]
        return self.labels[action][observation_label(channels, values)]

    def narrow(self, mine: IntArray) -> None:
        """Only states that look like the true one, and go on as it does, are possible."""
        seen = self.pomdp.observed[self.numbers[mine]]
        possible = (self.pomdp.observed[None, :] == seen[:, None]) & self.live[None, :]
        beliefs = np.where(possible, self.beliefs[mine], 0.0)
        mass = beliefs.sum(axis=1, keepdims=True)
        if not (mass > 0).all():
            raise ImpossibleObservation("a belief has lost the true state to rounding")
        self.beliefs[mine] = beliefs / mass
