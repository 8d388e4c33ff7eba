"""Plans of small partially observed models, and their execution again by enumeration of all states.

`ByHand` shares nothing with the controller but the plan's numbers: beliefs are vectors over all states,
updated with `explicit.exact_pomdp`; projected by the number of each state's block; alpha vectors are
compared one by one.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from factored_polca import library
from factored_polca.diagrams import Diagram, evaluate_states
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.hierarchy import Options, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.models import (
    Action,
    Feature,
    Model,
    Observation,
    Task,
    TaskHierarchy,
    boolean,
    flat_task,
)

NAMES = ("tiger", "meds", "cheese_taxi", "corridor", "finish")


def corridor(ending: bool = False) -> Model:
    """Light a lamp that is seen badly, and walk three places.

    With `ending` the episode is over in the last place with the lamp lit, and the place is seen.
    """
    place, lamp = Feature("place", range(3), observed=ending), boolean("lamp")
    glimmer = Observation("glimmer", ["none", "bright", "dark"])
    seen = "{bright: 0.8, dark: 0.2} if lamp' else {bright: 0.3, dark: 0.7}"
    return Model(
        "finish" if ending else "corridor",
        [place, lamp],
        [
            Action("step", {place: "{place + 1: 0.8, place: 0.2} if place < 2 else place"}),
            Action("back", {place: "0", lamp: "{true: 1/2, false: 1/2}"}),
            Action("toggle", {lamp: "{true: 0.9, false: 0.1} if not lamp else {false: 0.9, true: 0.1}"}),
            Action("look", senses={glimmer: seen}),
        ],
        rewards=["5 if place == 2 and lamp else -1 - place"]
        if not ending
        else ["-1", "8 if place == 2 else 0"],
        terminal="place == 2 and lamp" if ending else "false",
        initial={place: "{0: 1/2, 1: 1/2}", lamp: "{true: 1/4, false: 3/4}"},
        discount="0.9",
        observability="partial",
        observations=[glimmer],
    )


def corridor_tasks(*, only_children: bool = False, root_ends: bool = False) -> TaskHierarchy:
    own = [] if only_children else ["look", "back"]
    root = Task("Root", ["Light", "Go", *own], terminal="place == 2 and lamp" if root_ends else "false")
    return TaskHierarchy(
        [
            root,
            Task("Light", ["toggle", "look"], terminal="lamp", pseudo_rewards=-1),
            Task("Go", ["step", "back"], terminal="place == 2", pseudo_rewards="-1 - place"),
        ]
    )


@cache
def planned(name: str, only_children: bool = False) -> ExecutablePomdpPlan:
    """The plan of one of NAMES."""
    if name in ("corridor", "finish"):
        model, tasks = corridor(name == "finish"), corridor_tasks(only_children=only_children)
    else:
        domain = library.load(name)
        model, tasks = domain.model, domain.tasks or flat_task(domain.model)
    found = plan_pomdp(model, tasks, Options(trials=40, flat_block_limit=None))
    return executable_pomdp(found, {"value": 1.5, "standard_error": 0.25})


class ByHand:
    """A plan over all states; axes are a (action), o (joint observation), s and t (states)."""

    def __init__(self, plan: ExecutablePomdpPlan) -> None:
        self.plan, self.exact = plan, enumerate_pomdp(plan.model)
        exact, features = self.exact, plan.model.features
        self.digits = np.array(
            [[f.index(v) for f, v in zip(features, s, strict=True)] for s in exact.state_values],
            dtype=np.int32,
        )
        self.kernel = np.zeros((len(exact.actions), len(exact.observations), exact.states, exact.states))
        for a, rows in enumerate(exact.kernel):
            for s, row in enumerate(rows):
                for (t, o), chance in row.items():
                    self.kernel[a, o, s, t] = float(chance)
        self.rewards = np.array([[float(r) for r in row] for row in exact.rewards])  # [a, s]
        self.observed, self.terminal = np.array(exact.observed), np.array(exact.terminal)
        self.initial = np.array([float(q) for q in exact.initial])
        self.labels = {name: self.at(task.partition.diagram) for name, task in plan.policies.items()}
        self.over = {name: self.at(task.ended) == 1 for name, task in plan.policies.items()}

    def at(self, diagram: Diagram) -> np.ndarray:
        """The value of an index diagram at each state."""
        columns = self.plan.symbolic.columns()
        return evaluate_states(diagram, self.digits, columns).astype(np.int64)

    def projected(self, name: str, belief: np.ndarray) -> np.ndarray:
        """A belief over states as one over a task's blocks."""
        return np.bincount(self.labels[name], belief, self.plan.policies[name].partition.blocks)

    def value(self, name: str, belief: np.ndarray) -> float:
        """A task's value function at a belief over states, which need not sum to 1."""
        policy, blocks = self.plan.policies[name].policy, self.projected(name, belief)
        assert isinstance(policy, AlphaVectors)
        return sum(
            max(float(alpha @ blocks[part.states]) for alpha in part.vectors) for part in policy.sets
        )

    def first_choice(self, name: str, belief: np.ndarray) -> str:
        """What a task's vectors answer: the best one's action, of equal ones the lowest number."""
        task, blocks = self.plan.policies[name], self.projected(name, belief)
        assert isinstance(task.policy, AlphaVectors)
        parts = [part for part in task.policy.sets if blocks[part.states].sum() > 0]
        if not parts:
            return task.actions[0]
        part = max(parts, key=lambda part: blocks[part.states].sum())
        worth = [float(alpha @ blocks[part.states]) for alpha in part.vectors]
        close = max(worth) - 1e-13 * max(1.0, abs(max(worth)))
        return task.actions[min(int(a) for a, w in zip(part.actions, worth, strict=True) if w >= close)]

    def corner(self, name: str) -> np.ndarray:
        """The number of the primitive action that polling `name` leads to where the state is known [s]."""
        numbers = {action.name: i for i, action in enumerate(self.plan.model.actions)}
        result = np.zeros(len(self.digits), dtype=np.int64)
        for s, point in enumerate(np.eye(len(self.digits))):
            action = self.first_choice(name, point) if not self.over[name][s] else ""
            action = action or self.plan.policies[name].actions[0]
            result[s] = self.corner(action)[s] if action in self.plan.policies else numbers[action]
        return result

    def one_step(self, name: str, belief: np.ndarray, action: str) -> float:
        """R_c . b + gamma sum_o V(b K_c^o), a child c doing what it does where it is certain."""
        numbers = {act.name: i for i, act in enumerate(self.plan.model.actions)}
        taken = (
            self.corner(action)
            if action in self.plan.policies
            else np.full(len(self.digits), numbers[action])
        )
        states = np.arange(len(self.digits))
        now = float(self.rewards[taken, states] @ belief)
        after = [
            belief @ self.kernel[taken, o, states, :] for o in range(self.kernel.shape[1])
        ]  # [t], weighted by P(o)
        return now + float(self.plan.model.discount) * sum(self.value(name, b) for b in after)

    def answer(self, name: str, belief: np.ndarray) -> str:
        """What a task answers: a child that has surely ended is passed over for the best other one."""
        task, policies = self.plan.policies[name], self.plan.policies
        chosen = self.first_choice(name, belief)
        ended = [c for c in task.actions if c in policies and self.over[c][belief > 0].all()]
        if chosen in ended and len(ended) < len(task.actions):
            others = [c for c in task.actions if c not in ended]
            return max(others, key=lambda c: self.one_step(name, belief, c))
        return chosen

    def action(self, belief: np.ndarray) -> int:
        """The number of the primitive action."""
        name = self.plan.root
        while name in self.plan.policies:
            name = self.answer(name, belief)
        return [action.name for action in self.plan.model.actions].index(name)

    def expected_return(self, steps: int) -> float:
        """What the polled plan earns in so many steps: all beliefs that it can reach, equal ones merged."""
        total, weight = 0.0, 1.0
        frontier = self.split([(self.initial, 1.0)])
        for _ in range(steps):
            following: list[tuple[np.ndarray, float]] = []
            for belief, chance in frontier:
                action = self.action(belief)
                total += weight * chance * float(self.rewards[action] @ belief)
                for o in range(self.kernel.shape[1]):
                    after = belief @ self.kernel[action, o]
                    if after.sum() > 1e-15:
                        following.append((after / after.sum(), chance * after.sum()))
            frontier, weight = self.split(following), weight * float(self.plan.model.discount)
        return total

    def split(self, beliefs: list[tuple[np.ndarray, float]]) -> list[tuple[np.ndarray, float]]:
        """Beliefs by what is seen of the state, those of episodes that go on, equal ones together."""
        merged: dict[bytes, tuple[np.ndarray, float]] = {}
        for belief, chance in beliefs:
            for y in np.unique(self.observed[(belief > 0) & ~self.terminal]).tolist():
                part = np.where((self.observed == y) & ~self.terminal, belief, 0.0)
                mass = float(part.sum())
                part = part / mass
                key = np.round(part, 10).tobytes()
                merged[key] = (part, chance * mass + merged.get(key, (part, 0.0))[1])
        return list(merged.values())
