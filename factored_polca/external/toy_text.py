"""Environments of Gymnasium that tell their dynamics, as those of `toy_text` do, as models.

    P[s][a] = [(probability, next state, reward, terminated), ...]

*Ends.* `terminated` is said of a transition, not of a state: some environments reach a state both ways,
and what P says of a state after the end means nothing. States are explored from the start through
transitions that do not end. If every state is then reached one way only, the ended ones are the terminal
states; otherwise a feature `done` becomes true with the step that ends.

*Numbers.* Floats become the nearest fractions with a denominator up to `DENOMINATOR`; what a row then
misses of 1 goes to its largest entry. The largest change of a probability and of a reward is reported, and
refused beyond `tolerance`. A reward that differs between transitions with the same next state is their
conditional mean.

Gymnasium knows no discount, and its time limits are no part of P: the discount is an argument.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final, TypeAlias

from factored_polca.models import (
    FALSE,
    Action,
    Expression,
    Feature,
    Model,
    ModelError,
    Switch,
    as_expression,
    boolean,
    disjunction,
    lottery,
)

DENOMINATOR: Final = 10_000
TOLERANCE: Final = 1e-12
MOST_STATES: Final = 100_000

Target: TypeAlias = tuple[int, bool]
"""(next state, whether the step ends)"""

Row: TypeAlias = dict[Target, tuple[Fraction, Fraction]]
"""Target -> (probability, expected reward given the target)."""


@dataclass(frozen=True)
class ToyTextModel:
    """A model made from P, and how far its numbers are from the environment's floats."""

    model: Model
    probability_error: float  # the largest change of an entry of P, or of the start
    reward_error: float  # the largest change of a reward
    unreachable: int  # states of P that are no value of the feature `state`


def model_of(
    environment: Any,
    *,
    discount: Fraction | float | str = "99/100",
    name: str | None = None,
    action_names: Sequence[str] | None = None,
    tolerance: float = TOLERANCE,
) -> ToyTextModel:
    """The model of an environment with `P` and `initial_state_distrib`; wrappers are looked through.

    Raises:
        ModelError: an environment without them, rows that are no distributions, or numbers that change by
            more than `tolerance`.
    """
    inner = getattr(environment, "unwrapped", environment)
    table, start = getattr(inner, "P", None), getattr(inner, "initial_state_distrib", None)
    if table is None or start is None:
        raise ModelError(
            f"{type(inner).__name__} does not tell its dynamics: a model is made of environments with P "
            "and initial_state_distrib, as those of gymnasium.envs.toy_text"
        )
    spec = getattr(inner, "spec", None)
    title = name or (spec.id if spec is not None else type(inner).__name__)
    reader = _Reader(table)
    initial = {s: p for s, p in enumerate(reader.row(list(map(float, start)), "the start")) if p}
    rows = reader.explored(initial)
    worst = max(reader.probability_error, reader.reward_error)
    if worst > tolerance:
        raise ModelError(
            f"{title}: fractions with denominators up to {DENOMINATOR:,} miss its floats by {worst:.3g}; "
            f"give tolerance={worst:.3g} to accept that"
        )
    count = max(len(table[s]) for s in table)
    names = list(action_names) if action_names is not None else [f"a{a}" for a in range(count)]
    if len(names) != count:
        raise ModelError(f"{len(names)} action names for {count} actions")
    built = _Builder(rows, initial)
    model = Model(
        title,
        built.features,
        [built.action(a, text) for a, text in enumerate(names)],
        terminal=built.terminal,
        initial=built.initial(),
        discount=discount,
        description="made from an environment's P; time limits are left out",
    )
    left = len(table) - len(built.states)
    return ToyTextModel(model, reader.probability_error, reader.reward_error, left)


class _Reader:
    """Reads rows of P as fractions, and keeps how far these are off."""

    def __init__(self, table: Mapping[int, Mapping[int, Sequence[tuple[Any, ...]]]]) -> None:
        self.table = table
        self.probability_error = self.reward_error = 0.0

    def row(self, chances: Sequence[float], where: str) -> list[Fraction]:
        """Probabilities as fractions that sum to 1."""
        total = sum(chances)
        if not all(0 <= p <= 1 + 1e-9 for p in chances) or not abs(total - 1) <= 1e-6:
            raise ModelError(f"{where}: the probabilities sum to {total:.9g}, not to 1")
        exact = [Fraction(p).limit_denominator(DENOMINATOR) for p in chances]
        largest = max(range(len(exact)), key=lambda i: exact[i])
        exact[largest] += 1 - sum(exact)
        off = max(abs(float(e - Fraction(p))) for e, p in zip(exact, chances, strict=True))
        self.probability_error = max(self.probability_error, off)
        return exact

    def reward(self, value: float) -> Fraction:
        """A reward as a fraction."""
        exact = Fraction(float(value)).limit_denominator(DENOMINATOR)
        self.reward_error = max(self.reward_error, abs(float(exact - Fraction(float(value)))))
        return exact

    def explored(self, initial: Mapping[int, Fraction]) -> dict[int, list[Row]]:
        """The rows [a] of each state that can be reached before the end."""
        rows: dict[int, list[Row]] = {}
        stack = sorted(initial, reverse=True)
        while stack:
            state = stack.pop()
            if state in rows:
                continue
            if len(rows) >= MOST_STATES:
                raise ModelError(f"more than {MOST_STATES:,} states")
            rows[state] = [self._action(state, a) for a in range(len(self.table[state]))]
            stack += [t for row in rows[state] for (t, ends) in row if not ends]
        return rows

    def _action(self, state: int, action: int) -> Row:
        given = self.table[state][action]
        where = f"state {state}, action {action}"
        chances = self.row([float(p) for p, *_ in given], where)
        mass: dict[Target, Fraction] = defaultdict(Fraction)
        earned: dict[Target, Fraction] = defaultdict(Fraction)
        for chance, (_, target, reward, ends) in zip(chances, given, strict=True):
            mass[int(target), bool(ends)] += chance
            earned[int(target), bool(ends)] += chance * self.reward(reward)
        return {key: (p, earned[key] / p) for key, p in mass.items() if p}


class _Builder:
    """Features and expressions from explored rows."""

    def __init__(self, rows: Mapping[int, list[Row]], initial: Mapping[int, Fraction]) -> None:
        self.rows, self.start = rows, initial
        ways: dict[int, set[bool]] = {state: {False} for state in initial}
        for row in (row for found in rows.values() for row in found):
            for target, ends in row:
                ways.setdefault(target, set()).add(ends)
        self.states = sorted(ways)
        self.flagged = any(len(found) > 1 for found in ways.values())
        self.state, self.done = Feature("state", self.states), boolean("done")
        self.features = [self.state, self.done] if self.flagged else [self.state]
        last = [state for state in self.states if ways[state] == {True}]
        self.terminal: Expression = FALSE
        if self.flagged:
            self.terminal = self.done.now
        elif last:
            self.terminal = disjunction([self.state.is_(state) for state in last])

    def initial(self) -> dict[Feature, Expression]:
        """b0."""
        found = {self.state: lottery(_outcomes(self.start))}
        return found | ({self.done: as_expression(False)} if self.flagged else {})

    def action(self, number: int, name: str) -> Action:
        """An action's effects and rewards."""
        moves, ends, rewards = [], [], []
        for state, found in sorted(self.rows.items()):
            row = found[number]
            mass: dict[int, Fraction] = defaultdict(Fraction)
            for (target, _), (chance, _) in row.items():
                mass[target] += chance
            moves.append((state, lottery(_outcomes(mass))))
            ends.append((state, self._ending(row, mass)))
            rewards.append((state, self._reward(row, mass)))
        stay = self.state.now
        effects: dict[Feature, Expression] = {self.state: self._switch(moves, stay)}
        if self.flagged:
            effects[self.done] = self._switch(ends, as_expression(True))
        return Action(name, effects, rewards=[self._switch(rewards, as_expression(0))])

    def _ending(self, row: Row, mass: Mapping[int, Fraction]) -> Expression:
        """P(done' | state' = t) for each t of a row."""
        chances = {t: row.get((t, True), (Fraction(0), 0))[0] / mass[t] for t in mass}
        if len(set(chances.values())) == 1:
            return _chance(next(iter(chances.values())))
        cases = tuple((t, _chance(chance)) for t, chance in sorted(chances.items()))
        return Switch(self.state.next, cases, as_expression(False))

    def _reward(self, row: Row, mass: Mapping[int, Fraction]) -> Expression:
        """The expected reward given t."""
        means: dict[int, Fraction] = defaultdict(Fraction)
        for (target, _), (chance, reward) in row.items():
            means[target] += chance * reward / mass[target]
        if len(set(means.values())) == 1:
            return as_expression(next(iter(means.values())))
        cases = tuple((t, as_expression(mean)) for t, mean in sorted(means.items()))
        return Switch(self.state.next, cases, as_expression(0))

    def _switch(self, cases: Sequence[tuple[int, Expression]], otherwise: Expression) -> Expression:
        return Switch(self.state.now, tuple(cases), otherwise)


def _outcomes(chances: Mapping[int, Fraction]) -> list[tuple[Expression, Fraction]]:
    return [(as_expression(state), chance) for state, chance in sorted(chances.items()) if chance]


def _chance(chance: Fraction) -> Expression:
    if chance in (0, 1):
        return as_expression(chance == 1)
    return lottery([(as_expression(True), chance), (as_expression(False), 1 - chance)])
