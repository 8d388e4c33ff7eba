"""pomdp-py both ways, where it is installed: the extra `pomdp-py`."""

from __future__ import annotations

import numpy as np
import pytest
from small_pomdps import SEEDS, cheese, random_pomdp, tiger

from factored_polca.models import ModelError
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand

pomdp_py = pytest.importorskip("pomdp_py")
adapter = pytest.importorskip("factored_polca.external.pomdp_py_adapter")


@pytest.mark.parametrize("seed", SEEDS)
def test_there_and_back_values_stay(seed: int) -> None:
    """Where nothing is seen at the start: pomdp-py has no observation before the first action."""
    pomdp = random_pomdp(seed)
    if len(np.unique(pomdp.observed[(pomdp.initial > 0) & ~pomdp.terminal])) > 1:
        state = int(np.flatnonzero((pomdp.initial > 0) & ~pomdp.terminal)[0])
        pomdp = type(pomdp)(**{**vars(pomdp), "initial": np.eye(pomdp.states)[state]})
    back = adapter.arrays_of(adapter.agent_of(pomdp).agent, pomdp.discount)
    first, second = (solve_pomdp(p, "exact", demand=Demand(gap=1e-7)) for p in (pomdp, back))
    assert first.lower <= second.upper + 1e-6
    assert second.lower <= first.upper + 1e-6


def test_their_tiger_has_its_value() -> None:
    """Their listening moves the tiger with 10^-9, so the value is that of the tiger to 10^-4 or so."""
    tiger_problem = pytest.importorskip("pomdp_py.problems.tiger.tiger_problem")
    problem = tiger_problem.TigerProblem.create("tiger-left", 0.5, 0.15)
    found = solve_pomdp(adapter.arrays_of(problem.agent, 0.95), "exact", demand=Demand(gap=1e-6))
    assert found.lower == pytest.approx(19.371368, abs=1e-4)


def test_our_policy_plans_for_their_agent() -> None:
    pomdp = tiger(0.95)
    translation = adapter.agent_of(pomdp)
    policy = solve_pomdp(pomdp, "sarsop", demand=Demand(gap=1e-2)).policy
    planner, agent = adapter.PolicyPlanner(translation, policy), translation.agent
    heard = []
    for _ in range(3):
        action = planner.plan(agent)
        heard.append(action.data if hasattr(action, "data") else action.name)
        belief = pomdp_py.update_histogram_belief(
            agent.belief,
            action,
            translation.observations[0],
            agent.observation_model,
            agent.transition_model,
        )
        agent.set_belief(belief)
    assert heard == ["a0", "a0", "a2"]  # two growls on the left: open the right door


def test_their_planners_run_on_our_model() -> None:
    translation = adapter.agent_of(cheese(), seed=1)
    planner = pomdp_py.POUCT(
        max_depth=3, discount_factor=0.95, num_sims=50, rollout_policy=translation.agent.policy_model
    )
    assert planner.plan(translation.agent) in translation.actions


def test_samples_follow_the_probabilities() -> None:
    translation = adapter.agent_of(tiger(0.95), seed=2)
    agent, state, action = translation.agent, translation.states[0], translation.actions[0]
    assert all(agent.transition_model.sample(state, action) == state for _ in range(20))
    heard = [
        agent.observation_model.sample(state, action) == translation.observations[0] for _ in range(2000)
    ]
    assert abs(np.mean(heard) - 0.85) < 0.04  # five standard errors of 0.008


def test_what_can_not_be_listed_is_refused() -> None:
    class Nothing:
        @property
        def all_states(self) -> list[object]:
            raise NotImplementedError

    with pytest.raises(ModelError, match="can't be listed"):
        adapter.arrays_of(Nothing(), 0.9)
