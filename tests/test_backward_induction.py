"""Backward induction: values in closed form, by brute force over policies, and its refusals."""

from __future__ import annotations

import time
from itertools import product

import numpy as np
import pytest
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.models import LimitReached, ModelError
from factored_polca.solvers import backward_induction as module
from factored_polca.solvers.backward_induction import backward_induction


def mdp(rows: list[np.ndarray], rewards: np.ndarray, terminal: np.ndarray, discount: float) -> ArrayMDP:
    applicable = np.array([matrix.sum(axis=1) > 0 for matrix in rows])
    names = tuple(f"a{number}" for number in range(len(rows)))
    return ArrayMDP(
        names, tuple(csr_array(m) for m in rows), rewards * applicable, applicable, terminal, discount
    )


def random_mdp(seed: int, discount: float) -> ArrayMDP:
    random = np.random.default_rng(seed)
    rows = [random.dirichlet(np.full(3, 0.5), size=3) for _ in range(2)]
    terminal = np.array([False, False, seed % 2 == 1])
    for matrix in rows:
        matrix[terminal] = 0
    rows[1][0] = 0  # applies nowhere in state 0
    return mdp(rows, random.integers(-3, 4, (2, 3)).astype(float), terminal, discount)


@pytest.mark.parametrize("discount", [1.0, 0.5, 0.0])
@pytest.mark.parametrize("seed", range(4))
def test_no_staged_policy_is_better(seed: int, discount: float) -> None:
    """The best of all policies that choose an action for each state and step, in each state."""
    problem, horizon = random_mdp(seed, discount), 3
    dense = [matrix.toarray() for matrix in problem.transitions]
    best = np.full(3, -np.inf)
    for choices in product(product(range(2), repeat=3), repeat=horizon):
        values = np.zeros(3)
        if any(
            not problem.applicable[a, s] and not problem.terminal[s]
            for rule in choices
            for s, a in enumerate(rule)
        ):
            continue
        for rule in choices:
            values = np.array(
                [
                    0.0 if problem.terminal[s] else problem.rewards[a, s] + discount * dense[a][s] @ values
                    for s, a in enumerate(rule)
                ]
            )
        best = np.maximum(best, values)
    found = backward_induction(problem, horizon)
    np.testing.assert_allclose(found.values, best, atol=1e-12)
    assert found.policy.horizon == horizon
    assert 0 < found.error < 1e-12


def test_the_first_stages_look_further_than_the_last() -> None:
    """Invest (-1) to be paid 3 a step later, or take 1 now: with one step left only the latter pays."""
    take = np.eye(2)
    invest = np.array([[0.0, 1.0], [0.0, 1.0]])
    rewards = np.array([[1.0, 3.0], [-1.0, -1.0]])
    found = backward_induction(mdp([take, invest], rewards, np.zeros(2, dtype=bool), 1.0), 4)
    assert found.policy.actions[:, 0].tolist() == [0, 0, 1, 1]  # 1, then 2 each way: the first is taken
    assert found.values[0] == -1 + 3 * 3


def test_a_dead_end_costs_everything_while_steps_are_left() -> None:
    risky = np.array([[0.5, 0.5], [0.0, 0.0]])
    problem = mdp([risky], np.array([[1.0, 0.0]]), np.zeros(2, dtype=bool), 0.9)
    assert backward_induction(problem, 1).values.tolist() == [1.0, -np.inf]
    found = backward_induction(problem, 2)
    assert found.values.tolist() == [-np.inf, -np.inf]
    assert found.policy.actions.tolist() == [[0, -1], [-1, -1]]


def test_refusals(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = random_mdp(1, 0.9)
    with pytest.raises(ModelError, match="at least 1 step"):
        backward_induction(problem, 0)
    with pytest.raises(LimitReached, match="time limit: 0 of 5"):
        backward_induction(problem, 5, deadline=time.monotonic() - 1)
    monkeypatch.setattr(module, "MAXIMUM_CHOICES", 14)
    with pytest.raises(LimitReached, match="shorter"):
        backward_induction(problem, 5)
