"""The polling controller (the paper's section 4): at every step ask from the top.

The root's policy is asked at the state; if it answers a child, the child is asked, and so on until
a primitive action comes back.  There is no stack: a subtask may be left before it has ended, when
its parent answers something else at the next step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import at, evaluate_states
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.models import ModelError, Value


@dataclass(frozen=True)
class Poll:
    """One question on the way down: the task, the block the state lies in, and the answer.

    `action` is None where the task has ended (`terminal`) or has no way to avoid a dead end; `block`
    is None outside the states the plan was made for.
    """

    task: str
    block: int | None
    block_states: int
    action: str | None
    terminal: bool


@dataclass(frozen=True)
class Decision:
    """The primitive action at a state, None where there is none, and the polls that led to it."""

    action: str | None
    path: tuple[Poll, ...]


class Controller:
    """Executes a plan; it holds no state of its own."""

    def __init__(self, plan: ExecutablePlan) -> None:
        self.plan = plan

    def poll(self, state: Mapping[str, Value]) -> Decision:
        """The action at a state {feature: value}.

        Raises:
            ModelError: a feature that is missing or unknown, or a value it does not have.
        """
        levels = self._levels(state)
        path: list[Poll] = []
        name: str | None = self.plan.root
        while name is not None and name in self.plan.policies:
            policy = self.plan.policies[name]
            block = int(at(policy.partition.diagram, levels))
            if block >= policy.partition.blocks:
                path.append(Poll(name, None, 0, None, False))
                return Decision(None, tuple(path))
            chosen = int(policy.choice[block])
            action = policy.actions[chosen] if chosen >= 0 else None
            size = policy.partition.sizes[block]
            path.append(Poll(name, block, size, action, bool(policy.terminal[block])))
            name = action
        return Decision(name, tuple(path))

    def actions(self, states: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
        """The number of the action at each state [state, feature]; -1 where there is none."""
        symbolic = self.plan.symbolic
        taken = evaluate_states(self.plan.policy, states, symbolic.columns()).astype(np.int64)
        return np.where(taken < len(symbolic.actions), taken, -1)

    def _levels(self, state: Mapping[str, Value]) -> dict[int, int]:
        symbolic = self.plan.symbolic
        names = [feature.name for feature in symbolic.model.features]
        unknown = [name for name in state if name not in names]
        missing = [name for name in names if name not in state]
        if unknown:
            raise ModelError(f"no feature {unknown[0]!r}; there are {', '.join(names)}")
        if missing:
            raise ModelError(f"the state gives no value for {', '.join(missing)}")
        levels = {}
        for number, feature in enumerate(symbolic.model.features):
            index = feature.index(state[feature.name])
            if index is None:
                shown = [str(v).lower() if isinstance(v, bool) else str(v) for v in feature.values[:20]]
                raise ModelError(
                    f"{feature.name} has no value {state[feature.name]!r}; it has {', '.join(shown)}"
                )
            levels[symbolic.now(number)] = index
        return levels
