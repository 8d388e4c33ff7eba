"""What a minimisation must preserve: a decision process over the states of a symbolic model.

A `DecisionProcess` is a model, or one subtask of it.  Its choices are primitive actions, or
abstract actions: a child's finished policy, given as a diagram from states to primitive actions.
Everything is masked: with app_c = where choice c is applicable and the process not terminal,
rewards and transitions count only where app_c holds (Dean & Givan 1997; DESIGN 4, "masks first").
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import lcm, prod
from typing import Protocol

from factored_polca.diagrams import Diagram, choose, leaves
from factored_polca.symbolic import NumericView, SymbolicModel, Term
from factored_polca.symbolic.sensing import SensedRegression


@dataclass(frozen=True)
class Choice:
    """An action of a decision process.

    `primitives` are numbers of the model's actions; where there is a `policy`, it maps each state to
    the number of the one that is taken (any other leaf where the choice is not applicable), and
    without one there is a single primitive.
    """

    name: str
    app: Diagram
    primitives: tuple[int, ...]
    policy: Diagram | None = None

    def where(self, primitive: int) -> Diagram:
        """The condition that the choice stands for `primitive`."""
        manager = self.app.manager
        if self.policy is None:
            return manager.constant(1)
        return self.policy.equals(manager.constant(primitive))


class OpenNumbers(Protocol):
    """What a minimisation has to know of a process whose numbers depend on parameters that stay symbols.

    `degree` bounds the degree of the numbers, as polynomials with denominators cleared, in what is drawn;
    `bits` is to them what `difference_bits` is to rationals, `denominator` what `common_denominator` is.
    """

    @property
    def degree(self) -> int: ...

    @property
    def bits(self) -> int: ...

    @property
    def denominator(self) -> int: ...

    def draw(self, source: random.Random, prime: int) -> DecisionProcess:
        """The process at a random point, its numbers given by their residues."""
        ...


@dataclass(frozen=True)
class DecisionProcess:
    """States of a symbolic model, choices, a terminal set, and the reward of each primitive action.

    `rewards[p]` are the terms that primitive p earns here; `reachable` restricts attention to a set
    of states that no choice leaves (None: all).  `channels` are the numbers of the observations that
    count, None where the state is seen (a partially observed process may have none: blind).
    `open_numbers` are there where parameters stay symbols.
    """

    symbolic: SymbolicModel
    choices: tuple[Choice, ...]
    terminal: Diagram
    rewards: dict[int, tuple[Term, ...]]
    reachable: Diagram | None = None
    channels: tuple[int, ...] | None = None
    open_numbers: OpenNumbers | None = None

    @property
    def partial(self) -> bool:
        """Whether the process is partially observed."""
        return self.channels is not None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the choices."""
        return tuple(choice.name for choice in self.choices)


def flat_process(
    symbolic: SymbolicModel,
    actions: Sequence[str] | None = None,
    reachable: Diagram | None = None,
    terminal: Diagram | None = None,
) -> DecisionProcess:
    """The decision process of the model itself, or of some of its actions.

    `terminal` takes the place of the model's terminal set, which it must contain.

    Raises:
        KeyError: an unknown action; the message lists those there are.
    """
    names = [action.name for action in symbolic.actions]
    wanted = names if actions is None else list(actions)
    for name in wanted:
        if name not in names:
            raise KeyError(f"no action {name!r}; there are {', '.join(names)}")
    numbers = [names.index(name) for name in wanted]
    rewards = {n: symbolic.actions[n].rewards for n in numbers}
    channels = None
    if symbolic.model.observability == "partial":
        channels = tuple(range(len(symbolic.model.observations)))
    if terminal is None:
        choices = tuple(Choice(names[n], symbolic.actions[n].app, (n,)) for n in numbers)
        return DecisionProcess(symbolic, choices, symbolic.terminal, rewards, reachable, channels)
    live = ~terminal
    choices = tuple(Choice(names[n], symbolic.actions[n].app & live, (n,)) for n in numbers)
    return DecisionProcess(symbolic, choices, terminal, rewards, reachable, channels)


class ProcessView:
    """A decision process in numbers of one leaf type: masked rewards and regressions.

    Regressions of a primitive are shared by all choices that stand for it.
    """

    def __init__(
        self, process: DecisionProcess, numbers: NumericView, sensed: SensedRegression | None = None
    ) -> None:
        self.process = process
        self.numbers = numbers
        self.sensed = sensed
        self._rewards: dict[int, Diagram] = {}

    def app(self, choice: Choice) -> Diagram:
        """Where the choice counts."""
        reachable = self.process.reachable
        return choice.app if reachable is None else choice.app & reachable

    def _primitive_reward(self, primitive: int) -> Diagram:
        if primitive not in self._rewards:
            self._rewards[primitive] = self.numbers.total(self.process.rewards[primitive])
        return self._rewards[primitive]

    def select(self, choice: Choice, parts: dict[int, Diagram]) -> Diagram:
        """The part of the primitive that the choice stands for, 0 where it is not applicable."""
        result = self.numbers.zero
        for primitive, part in parts.items():
            result = choose(choice.where(primitive), part, result)
        return choose(self.app(choice), result, self.numbers.zero)

    def reward(self, choice: Choice) -> Diagram:
        """R_c(x), 0 where the choice is not applicable."""
        return self.select(choice, {p: self._primitive_reward(p) for p in choice.primitives})

    def regress(self, choice: Choice, value: Diagram, memo: dict[int, Diagram]) -> Diagram:
        """sum_x' T_c(x, x') V(x'), 0 where the choice is not applicable; with observations weighed in
        where there is a `SensedRegression`.

        `memo` keeps the regressions of primitives of this `value`.
        """
        for primitive in choice.primitives:
            if primitive not in memo:
                regress = self.numbers.regress if self.sensed is None else self.sensed.regress
                memo[primitive] = regress(primitive, value)
        return self.select(choice, {p: memo[p] for p in choice.primitives})


def policy_primitives(policy: Diagram, defined: Diagram, count: int) -> tuple[int, ...]:
    """The primitive actions (numbers below `count`) that a policy takes where it is defined."""
    manager = policy.manager
    masked = choose(defined, policy, manager.constant(count))
    return tuple(sorted(int(leaf) for leaf in leaves(masked) if int(leaf) < count))


def row_denominator(process: DecisionProcess, primitive: int) -> int:
    """The product over features and channels of their rows' denominators.

    It makes T_p(x, x') and T_p(x, x') P_p(o | x', x) integers everywhere.
    """
    action = process.symbolic.actions[primitive]
    sensed = [action.observations[j] for j in process.channels or () if j in action.observations]
    rows = [*action.rows.values(), *sensed]
    return prod(lcm(*(q.denominator for row in r.rows for q in row)) for r in rows)


def reward_denominator(process: DecisionProcess, primitive: int) -> int:
    """A common multiple of the denominators of the reward terms of a primitive."""
    return lcm(*(value.denominator for term in process.rewards[primitive] for value in term.values))


def largest_reward(process: DecisionProcess, primitive: int) -> Fraction:
    """A bound on |R_p(x)|: the largest absolute values of the terms, added up."""
    terms = process.rewards[primitive]
    return sum((max(abs(value) for value in term.values) for term in terms), Fraction(0))


def common_denominator(process: DecisionProcess) -> int:
    """A multiple of every denominator of a probability or reward that the process uses."""
    if process.open_numbers is not None:
        return process.open_numbers.denominator
    primitives = {p for choice in process.choices for p in choice.primitives}
    used = [f(process, p) for p in sorted(primitives) for f in (row_denominator, reward_denominator)]
    return lcm(*used)
