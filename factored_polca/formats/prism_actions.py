"""Actions from the commands of a PRISM program.

In an MDP a choice is a command without a label, or one command with the label a of each module that has
commands with it, whose outcomes are independent of each other. The guard of a choice is that all its
guards hold.

An action here is a set of choices of which at most one is enabled anywhere, so that nothing is lost.
Commands of one module and one label are put together while their guards exclude each other; where guards
overlap, they are put apart: that is nondeterminism, and gives distinct actions a_1, a_2, ... A command
without a label is an action of its own, named after its module.

A DTMC is one action `step`: it takes one of the enabled choices, each with the same probability. Where
nothing is enabled, a deadlock, PRISM lets the state stay as it is for ever; so it is here, by an action
`stay` in an MDP.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations as pairs
from itertools import product as combinations
from typing import Final

from factored_polca.formats.prism_expressions import choose
from factored_polca.formats.prism_guards import Guards
from factored_polca.formats.prism_outcomes import Outcome, effects_of, product
from factored_polca.formats.prism_program import Command, Program
from factored_polca.formats.prism_ranges import inside_bounds
from factored_polca.formats.prism_text import Place
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import (
    FALSE,
    ONE,
    TRUE,
    ZERO,
    Expression,
    Operation,
    Reference,
    Switch,
    conjunction,
    disjunction,
    operation,
    references,
)
from factored_polca.models.model import Action
from factored_polca.models.scalars import Value

MAXIMUM_ACTIONS: Final = 10_000
MAXIMUM_OUTCOMES: Final = 4_096
"""Of one step of a DTMC whose choices overlap, all choices together."""


FEW: Final = 500
"""Commands among which each two are compared."""

Case = tuple[Expression, Expression]
"""A guard, and what holds or happens where it holds."""


@dataclass(frozen=True)
class Group:
    """Commands of one module and label whose guards exclude each other."""

    commands: tuple[Command, ...]

    @property
    def guard(self) -> Expression:
        """Where one of them is enabled."""
        return any_of([command.guard for command in self.commands])


@dataclass(frozen=True)
class Choice:
    """A group of each module that has commands with a label; `label` is empty for a command without."""

    name: str
    label: str
    groups: tuple[Group, ...]

    @property
    def guard(self) -> Expression:
        """Where the choice is enabled."""
        return all_of([group.guard for group in self.groups])

    @property
    def place(self) -> Place:
        """Where its first command stands."""
        return self.groups[0].commands[0].place


def all_of(conditions: Sequence[Expression]) -> Expression:
    """A conjunction without parts that are true."""
    kept = [c for c in dict.fromkeys(conditions) if c != TRUE]
    return FALSE if FALSE in kept else conjunction(kept)


def any_of(conditions: Sequence[Expression]) -> Expression:
    """A disjunction without parts that are false."""
    kept = [c for c in dict.fromkeys(conditions) if c != FALSE]
    return TRUE if TRUE in kept else disjunction(kept)


def without(guard: Expression, name: str) -> Expression:
    """A conjunction without the parts that test `name` alone."""
    is_and = isinstance(guard, Operation) and guard.operator == "and"
    parts = guard.arguments if is_and and isinstance(guard, Operation) else (guard,)
    return all_of([part for part in parts if {r.name for r in references(part)} != {name}])


class Actions:
    """The actions of a program, `terminal` being where it ends; rewards are the caller's."""

    def __init__(self, program: Program, terminal: Expression) -> None:
        self.program, self.terminal = program, terminal
        self.guards = Guards(program.features, program.parameters)
        self.features = {feature.name: feature for feature in program.features}
        self.order = list(self.features)
        self.warnings: list[Fault] = []
        self.modules = tuple(
            (name, tuple(self._inside(command) for command in commands))
            for name, commands in program.modules
        )
        self.choices = list(self._choices())

    def _inside(self, command: Command) -> Command:
        result, warning = inside_bounds(command, self.features, self.guards)
        if warning is not None:
            self.warnings.append(warning)
        return result

    # -- choices ---------------------------------------------------------------------------------

    def _choices(self) -> Iterator[Choice]:
        labelled: dict[str, dict[str, list[Command]]] = {}  # label -> module -> commands
        lone: list[Command] = []
        for module, commands in self.modules:
            for command in commands:
                if command.guard == FALSE:
                    continue
                if command.label:
                    labelled.setdefault(command.label, {}).setdefault(module, []).append(command)
                else:
                    lone.append(command)
        having = {
            label: [
                module
                for module, commands in self.modules
                if any(command.label == label for command in commands)
            ]
            for label in labelled
        }
        taken = set(labelled)
        count = 0
        for label, modules in labelled.items():
            if len(modules) < len(having[label]):
                continue  # a module has commands with this label, none of which can be enabled
            parts = [self._groups(modules[module]) for module in having[label]]
            total = 1
            for groups in parts:
                total *= len(groups)
            count += total
            if count > MAXIMUM_ACTIONS:
                raise _too_many(modules[having[label][0]][0].place)
            names = [label] if total == 1 else list(_numbered(label, total, taken))
            for name, groups_of in zip(names, combinations(*parts), strict=True):
                yield Choice(name, label, groups_of)
        per_module: dict[str, list[Command]] = {}
        for command in lone:
            per_module.setdefault(command.module, []).append(command)
        for module, own in per_module.items():
            many = len(own) > 1 or module in taken
            names = list(_numbered(module, len(own), taken)) if many else [module]
            taken |= set(names)
            for name, command in zip(names, own, strict=True):
                yield Choice(name, "", (Group((command,)),))

    def _groups(self, commands: Sequence[Command]) -> list[Group]:
        if self._exclude([(command.guard, TRUE) for command in commands]):
            return [Group(tuple(commands))]
        groups: list[list[Command]] = []
        for command in commands:
            for group in groups:
                if all(self.guards.exclusive(command.guard, other.guard) for other in group):
                    group.append(command)
                    break
            else:
                groups.append([command])
        return [Group(tuple(group)) for group in groups]

    def _exclude(self, cases: Sequence[Case]) -> bool:
        """Whether each two guards exclude each other; dividing them by a variable tells many apart."""
        if len(cases) < 2:
            return True
        name, classes = self._divided(cases)
        if len(classes) > 1:
            return all(
                self._exclude([(without(guard, name), rest) for guard, rest in inside])
                for inside in classes.values()
            )
        return len(cases) <= FEW and all(
            self.guards.exclusive(one, other) for (one, _), (other, _) in pairs(cases, 2)
        )

    # -- effects ---------------------------------------------------------------------------------

    def effects(self, choice: Choice) -> dict[str, Expression]:
        """The effects of a choice where it is enabled."""
        found: dict[str, Expression] = {}
        for group in choice.groups:
            of_command = {command: _outcomes_of(command) for command in group.commands}
            parts = {c: effects_of(outcomes, self.program.features) for c, outcomes in of_command.items()}
            for name in (n for n in self.order if any(n in effects for effects in parts.values())):
                if name in found:
                    raise _twice(name, choice)
                persists = Reference(name)
                cases = [(c.guard, effects.get(name, persists)) for c, effects in parts.items()]
                found[name] = self.select(cases, persists, complete=True)
        return found

    def select(self, cases: Sequence[Case], rest: Expression, *, complete: bool = False) -> Expression:
        """The expression of the one case whose guard holds; `rest` where none does.

        `complete` says that one does.  A variable whose tests divide the cases is decided first.
        """
        if not complete:
            cases = [case for case in cases if case[1] != rest]
        if not cases:
            return rest
        if len(cases) == 1 or (complete and len({expression for _, expression in cases}) == 1):
            guard, expression = cases[0]
            return expression if complete else choose(guard, expression, rest)
        name, classes = self._divided(cases)
        if len(classes) > 1:
            branches = []
            for values, inside in classes.items():
                result = self.select([(without(g, name), e) for g, e in inside], rest, complete=complete)
                branches += [(value, result) for value in sorted(values)]
            feature = self.features[name]
            return Switch(
                feature.now, tuple(branches), None if len(branches) == len(feature.values) else rest
            )
        half = len(cases) // 2
        first = self.select(cases[:half], rest, complete=True)
        second = self.select(cases[half:], rest, complete=complete)
        return choose(any_of([guard for guard, _ in cases[:half]]), first, second)

    def _divided(self, cases: Sequence[Case]) -> tuple[str, dict[frozenset[Value], list[Case]]]:
        """A variable for whose values all guards have tests, equal or disjoint, and the cases by test."""
        tests = [self.guards.allowed(guard) for guard, _ in cases]
        best: tuple[str, dict[frozenset[Value], list[Case]]] = ("", {})
        for name in tests[0]:
            if not all(test.get(name) for test in tests):
                continue
            classes: dict[frozenset[Value], list[Case]] = {}
            for test, case in zip(tests, cases, strict=True):
                classes.setdefault(test[name], []).append(case)
            if sum(map(len, classes)) == len(frozenset().union(*classes)) and len(classes) > len(best[1]):
                best = (name, classes)
        return best

    # -- the actions of a program ------------------------------------------------------------------

    def of_mdp(self, rewards: Callable[[str], list[Expression]]) -> Iterator[tuple[Action, Place]]:
        """The actions of an MDP; `rewards(label)` are the terms of an action's own reward."""
        for choice in self.choices:
            yield (
                Action(
                    choice.name,
                    self.effects(choice),
                    applicable=choice.guard,
                    rewards=rewards(choice.label),
                ),
                choice.place,
            )
        stuck = operation("not", any_of([choice.guard for choice in self.choices]))
        if not self.choices or self.guards.satisfiable(all_of([stuck, operation("not", self.terminal)])):
            taken = {choice.name for choice in self.choices}
            name = "stay" if "stay" not in taken else next(_numbered("stay", 1, taken))
            yield Action(name, {}, applicable=stuck if self.choices else TRUE), (0, 0)

    def of_dtmc(self, rewards: Callable[[str], list[Expression]]) -> Action:
        """The one action of a DTMC."""
        exclusive = all(
            self.guards.exclusive(one.guard, other.guard)
            for index, one in enumerate(self.choices)
            for other in self.choices[:index]
        )
        if exclusive:
            parts = [(choice, self.effects(choice)) for choice in self.choices]
            effects = {}
            for name in self.order:
                persists = Reference(name)
                cases = [(choice.guard, part.get(name, persists)) for choice, part in parts]
                expression = self.select(cases, persists)
                if expression != persists:
                    effects[name] = expression
            terms = [
                choose(choice.guard, term, ZERO) for choice, _ in parts for term in rewards(choice.label)
            ]
            return Action("step", effects, rewards=terms)
        return self._mixture(rewards)

    def _mixture(self, rewards: Callable[[str], list[Expression]]) -> Action:
        """A step of a DTMC some of whose choices can be enabled together."""
        weighted: list[tuple[Expression, Choice, list[Outcome]]] = []
        total = 0
        for choice in self.choices:
            for commands in combinations(*(group.commands for group in choice.groups)):
                guard = all_of([command.guard for command in commands])
                outcomes: list[Outcome] = [(ONE, {})]
                for command in commands:
                    _refuse_clash(outcomes, command, choice)
                    outcomes = product(outcomes, _outcomes_of(command))
                    if total + len(outcomes) > MAXIMUM_OUTCOMES:
                        raise _too_many(choice.place, "outcomes", MAXIMUM_OUTCOMES)
                total += len(outcomes)
                weighted.append((guard, choice, outcomes))
        number: Expression = operation("add", *(choose(g, ONE, ZERO) for g, _, _ in weighted))
        stuck = operation("equal", number, ZERO)
        divisor = choose(stuck, ONE, number)
        joint: list[Outcome] = [(choose(stuck, ONE, ZERO), {})]
        terms = []
        for guard, choice, outcomes in weighted:
            share = operation("divide", choose(guard, ONE, ZERO), divisor)
            joint += [
                (choose(guard, operation("divide", chance, divisor), ZERO), updates)
                for chance, updates in outcomes
            ]
            terms += [operation("multiply", share, term) for term in rewards(choice.label)]
        return Action("step", effects_of(joint, self.program.features), rewards=terms)


def _outcomes_of(command: Command) -> list[Outcome]:
    return [(chance, dict(updates)) for chance, updates in command.outcomes]


def _numbered(stem: str, count: int, taken: set[str]) -> Iterator[str]:
    """`stem_1`, `stem_2`, ... that are not taken."""
    number = 0
    while count:
        number += 1
        name = f"{stem}_{number}"
        if name not in taken:
            count -= 1
            yield name


def _refuse_clash(outcomes: Sequence[Outcome], command: Command, choice: Choice) -> None:
    before: Mapping[str, Expression]
    before = {name: value for _, updates in outcomes for name, value in updates.items()}
    for _, updates in command.outcomes:
        for name, _ in updates:
            if name in before:
                raise _twice(name, choice)


def _twice(name: str, choice: Choice) -> ModelError:
    line, column = choice.place
    message = f"two modules change {name} in one step, by the action {choice.label!r}"
    return ModelError(
        [Fault(message, hint="one module at a time may change a variable", line=line, column=column)]
    )


def _too_many(place: Place, what: str = "actions", limit: int = MAXIMUM_ACTIONS) -> ModelError:
    message = f"the commands that can run together make more than {limit:,} {what}"
    hint = "make guards of commands with the same label exclude each other"
    return ModelError([Fault(message, hint=hint, line=place[0], column=place[1])])
