"""Simulation of a plan on the original model.

The return of an episode is sum_t gamma^t r_t up to the end of the episode or `steps`.  The mean over
episodes is reported with its standard error s / sqrt(n), s the sample standard deviation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from factored_polca.control import Controller
from factored_polca.drawn import Drawn, Framed
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.simulation.sampler import Sampler, States
from factored_polca.symbolic import SymbolicModel


@dataclass(frozen=True)
class Simulation(Drawn, Framed):
    """Returns of episodes.

    `ended` counts episodes that reached a state where the policy has no action; `truncation` bounds
    what a longer run could change in the mean: gamma^steps / (1 - gamma) times the largest reward
    seen, 0 if all episodes ended.
    """

    mean: float
    standard_error: float
    episodes: int
    steps: int
    ended: int
    truncation: float
    returns: npt.NDArray[np.float64]


def default_steps(discount: float) -> int:
    """Steps after which what is left weighs less than a millionth; 10,000 without discount."""
    if discount <= 0:
        return 1
    if discount >= 1:
        return 10_000
    return max(1, math.ceil(math.log(1e-6 * (1 - discount)) / math.log(discount)))


StateActions = Callable[[States, int], npt.NDArray[np.int64]]
"""The numbers of the actions [episode], -1 for none, at states [episode, feature] after so many steps."""


def simulate(
    plan: ExecutablePlan, *, episodes: int = 1000, steps: int | None = None, seed: int = 0
) -> Simulation:
    """Run a plan from its initial belief.

    Raises:
        ValueError: fewer than one episode or step.
    """
    controller = Controller(plan)
    return simulate_actions(
        plan.symbolic,
        lambda states, _: controller.actions(states),
        episodes=episodes,
        steps=steps,
        seed=seed,
    )


def simulate_actions(
    symbolic: SymbolicModel,
    choose: StateActions,
    *,
    episodes: int = 1000,
    steps: int | None = None,
    seed: int = 0,
) -> Simulation:
    """Run anything that chooses actions at states from the initial belief.

    Equal seeds draw equal uniform numbers whatever is chosen (common random numbers).

    Raises:
        ValueError: fewer than one episode or step.
    """
    if episodes < 1 or (steps is not None and steps < 1):
        raise ValueError("episodes and steps must be at least 1")
    discount = float(symbolic.model.discount)
    length = default_steps(discount) if steps is None else steps
    generator = np.random.default_rng(seed)
    sampler = Sampler(symbolic)
    states = sampler.initial(episodes, generator)
    returns = np.zeros(episodes)
    running = np.ones(episodes, dtype=bool)
    weight, largest = 1.0, 0.0
    for step in range(length):
        actions = np.where(running, choose(states, step), -1)
        running &= actions >= 0
        if not running.any():
            break
        states, rewards = sampler.step(states, actions, generator)
        returns += weight * rewards
        largest = max(largest, float(np.abs(rewards).max()))
        weight *= discount
    ended = int((~running).sum())
    truncation = 0.0 if ended == episodes else math.inf
    if ended < episodes and discount < 1:
        truncation = weight / (1 - discount) * largest
    error = float(returns.std(ddof=1) / math.sqrt(episodes)) if episodes > 1 else math.nan
    return Simulation(float(returns.mean()), error, episodes, length, ended, truncation, returns)
