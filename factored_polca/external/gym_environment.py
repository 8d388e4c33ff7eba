"""A model as an environment of Gymnasium (Towers et al. 2024; the extra `gym`).

*Observations.* Where the state is seen: `MultiDiscrete`, the value number of each feature. Where it is
not: `Dict`, for each channel and each observed feature the number of its value. Before the first action a
channel reports its null value; where that is none of its values, one more number stands for "nothing yet".

*Actions.* `Discrete`, in the model's order. `info["action_mask"]` says which apply. One that does not
apply changes nothing and earns `inapplicable_reward` (a learner need not know the mask).

*Rewards.* "sampled": the terms at what was drawn, x and x'; "expected": R(x, a), whose returns have the
same mean and vary less. Terms over observations are expectations in both. Gymnasium knows no discount: the
model's is `environment.discount`.

*Ends.* `terminated` once a terminal state is reached, which earns 0; a start that is terminal ends with
the first step. `truncated` after `max_steps` (the model's horizon if there is one), and in a dead end, a
state without an applicable action (`info["dead_end"]`).

All draws come from the generator that `reset(seed=...)` seeds.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import evaluate_states
from factored_polca.models import Model
from factored_polca.models.features import position
from factored_polca.simulation.sampler import Sampler
from factored_polca.symbolic import SymbolicModel, compile_model

try:
    import gymnasium
    from gymnasium import spaces
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"{error}: pip install 'factored-polca[gym]'") from error

Rewards = Literal["sampled", "expected"]


class ModelEnvironment(gymnasium.Env[Any, Any]):
    """See the module's docstring.

    Raises:
        ModelError: the model is not right.
        ValueError: unknown rewards or render mode, or fewer than one step.
    """

    metadata = {  # noqa: RUF012
        "render_modes": ["ansi"]
    }

    def __init__(
        self,
        model: Model,
        *,
        rewards: Rewards = "sampled",
        max_steps: int | None = None,
        inapplicable_reward: float = 0.0,
        render_mode: str | None = None,
    ) -> None:
        if rewards not in ("sampled", "expected"):
            raise ValueError(f"rewards are {rewards!r}: give sampled or expected")
        if render_mode not in (None, "ansi"):
            raise ValueError(f"the render mode is {render_mode!r}: there is ansi only")
        if max_steps is not None and max_steps < 1:
            raise ValueError("max_steps must be at least 1")
        self.model, self.rewards, self.render_mode = model, rewards, render_mode
        self.max_steps = model.horizon if max_steps is None else max_steps
        self.inapplicable_reward = float(inapplicable_reward)
        self.discount = float(model.discount)
        self._symbolic: SymbolicModel = compile_model(model)
        self._sampler, self._columns = Sampler(self._symbolic), self._symbolic.columns()
        self._seen = [i for i, f in enumerate(model.features) if f.observed]
        self._state: npt.NDArray[np.int32] | None = None  # [1, feature]
        self._steps = 0
        self.action_space = spaces.Discrete(len(model.actions))
        self.observation_space = self._space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """A state drawn from the initial belief: what is seen of it, and the mask of actions."""
        super().reset(seed=seed)
        self._state, self._steps = self._sampler.initial(1, self.np_random), 0
        return self._observation(None), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One step: observation, reward, terminated, truncated, and the mask of actions.

        Raises:
            RuntimeError: before the first reset.
            ValueError: no such action.
        """
        if self._state is None:
            raise RuntimeError("call reset before the first step")
        number = int(action)
        if not 0 <= number < len(self.model.actions):
            raise ValueError(f"no action {number}; there are {len(self.model.actions)}")
        before, actions = self._state, np.array([number], dtype=np.int64)
        self._steps += 1
        if self._ended():
            return self._observation(None), 0.0, True, False, self._info()
        if not self._mask()[number]:
            return self._after(self.inapplicable_reward, None)
        following, earned = self._sampler.step(before, actions, self.np_random)
        if self.rewards == "expected":
            earned = self._sampler.expected_rewards(self._symbolic.actions[number].rewards, before)
        channels = self._sampler.observe(before, actions, following, self.np_random)
        self._state = following
        return self._after(float(earned[0]), channels[0])

    def render(self) -> str | None:
        """The state as text, where the render mode is "ansi"."""
        if self.render_mode is None or self._state is None:
            return None
        return ", ".join(f"{name}={value}" for name, value in self.state.items())

    @property
    def state(self) -> dict[str, Any]:
        """The state {feature: value}, seen or not.

        Raises:
            RuntimeError: before the first reset.
        """
        if self._state is None:
            raise RuntimeError("call reset first")
        pairs = zip(self.model.features, self._state[0].tolist(), strict=True)
        return {feature.name: feature.values[value] for feature, value in pairs}

    # -- pieces ------------------------------------------------------------------------------------

    def _space(self) -> spaces.Space[Any]:
        if self.model.observability == "full":
            return spaces.MultiDiscrete([len(feature.values) for feature in self.model.features])
        parts: dict[str, spaces.Space[Any]] = {}
        for channel in self.model.observations:
            parts[channel.name] = spaces.Discrete(len(channel.values) + (_null(channel) is None))
        for i in self._seen:
            feature = self.model.features[i]
            parts[feature.name] = spaces.Discrete(len(feature.values))
        return spaces.Dict(parts or {"nothing": spaces.Discrete(1)})

    def _observation(self, channels: npt.NDArray[np.int64] | None) -> Any:
        assert self._state is not None
        if self.model.observability == "full":
            return self._state[0].astype(np.int64)
        found: dict[str, Any] = {}
        for number, channel in enumerate(self.model.observations):
            null = _null(channel)
            nothing = len(channel.values) if null is None else null
            found[channel.name] = np.int64(nothing if channels is None else channels[number])
        for i in self._seen:
            found[self.model.features[i].name] = np.int64(self._state[0, i])
        return found or {"nothing": np.int64(0)}

    def _after(
        self, reward: float, channels: npt.NDArray[np.int64] | None
    ) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        ended, info = self._ended(), self._info()
        lost = not ended and not info["action_mask"].any()
        if lost:
            info["dead_end"] = True
        late = self.max_steps is not None and self._steps >= self.max_steps
        return self._observation(channels), reward, ended, not ended and (late or lost), info

    def _ended(self) -> bool:
        assert self._state is not None
        return bool(self._sampler.terminal(self._state)[0])

    def _mask(self) -> npt.NDArray[np.int8]:
        assert self._state is not None
        found = [evaluate_states(a.app, self._state, self._columns)[0] for a in self._symbolic.actions]
        return np.array(found, dtype=np.int8)

    def _info(self) -> dict[str, Any]:
        return {"action_mask": self._mask()}


def _null(channel: Any) -> int | None:
    """The number of a channel's null value, None where it is none of its values."""
    return position(channel.values, channel.null)
