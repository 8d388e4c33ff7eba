"""PolCA run where the state is not seen: a policy of states, asked at the likeliest one (DESIGN 5).

The belief is tracked exactly, or as the chosen tracker does.  Over blocks the likeliest block counts, and
of equal ones the first, as for `belief_policies.MostLikelyPolicy`; blocks where the policy has no action
are passed over.  Other trackers give the likeliest state; where the policy has no action there, the action
that is right with the highest probability is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.control.block_tracker import BlockBelief
from factored_polca.control.controller import Controller, Poll
from factored_polca.control.tracker import (
    TIE,
    Belief,
    ChosenTracker,
    OnImpossible,
    choose_tracker,
    tested_features,
)
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.models import ModelError, Value


@dataclass(frozen=True)
class LikeliestDecision:
    """The primitive action at a belief, its number, and the polls at the likeliest `state`.

    The action is None and its number -1 where the policy has none at any state that may be.
    """

    action: str | None
    number: int
    state: dict[str, Value]
    path: tuple[Poll, ...]


def likeliest_tracker(
    plan: ExecutablePlan, *, on_impossible: OnImpossible = "error", seed: int = 0
) -> ChosenTracker:
    """The tracker that fits a policy of states: it keeps apart the values of all features that this knows.

    Features that no task of the plan tells apart do not count for what is likeliest.
    """
    known = [plan.policy, *(task.partition.diagram for task in plan.policies.values())]
    return choose_tracker(
        plan.symbolic,
        conditions=[plan.policy],
        features=tested_features(plan.symbolic, known),
        on_impossible=on_impossible,
        seed=seed,
    )


class LikeliestController:
    """Executes a plan that was made as if the state were seen; it holds no state of its own."""

    def __init__(self, plan: ExecutablePlan) -> None:
        self.plan, self._controller = plan, Controller(plan)

    def poll(self, belief: Belief) -> LikeliestDecision:
        """The action at a belief.

        Raises:
            ModelError: the belief's tracker does not tell apart what the policy does.
        """
        state, number = self._block(belief) if isinstance(belief, BlockBelief) else self._state(belief)
        actions = self.plan.symbolic.actions
        name = None if number < 0 else actions[number].name
        return LikeliestDecision(name, number, state, self._controller.poll(state).path)

    def _block(self, belief: BlockBelief) -> tuple[dict[str, Value], int]:
        tracker = belief.tracker
        labels = tracker.labels(self.plan.policy)[belief.blocks]
        if (labels < 0).any():
            raise ModelError("the policy divides a block of the tracker")
        able = np.where(labels < len(self.plan.symbolic.actions), belief.weights, 0.0)
        if not able.any():
            return belief.most_likely(), -1
        place = int(np.argmax(able >= (1 - TIE) * able.max()))
        return tracker.state(tracker.states[belief.blocks[place]]), int(labels[place])

    def _state(self, belief: Belief) -> tuple[dict[str, Value], int]:
        state, policy = belief.most_likely(), self.plan.policy
        features = self.plan.model.features
        digits = np.array([[f.index(state[f.name]) for f in features]], dtype=np.int32)
        number = int(self._controller.actions(digits)[0])
        if number < 0:
            constants = map(policy.manager.constant, range(len(self.plan.symbolic.actions)))
            chances = [belief.probability(policy.equals(one)) for one in constants]
            number = int(np.argmax(chances)) if max(chances) > 0 else -1
        return state, number
