"""A PRISM program over features: constants given their values, expressions in our language.

Constants: those set on the command line have the value given there, whatever the program says, and others
the one that the program defines. Integer and truth constants are replaced by their values. A `double`
constant that is a number becomes a parameter of the model, one that is computed from others is written
out, so that it follows them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

from factored_polca.formats.prism_expressions import Translator
from factored_polca.formats.prism_process import RawProgram
from factored_polca.formats.prism_text import Place, Scan, StructureText
from factored_polca.models.check import MAXIMUM_VALUES
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Constant, Expression, Parameter, Reference
from factored_polca.models.features import Feature
from factored_polca.models.language import number
from factored_polca.models.scalars import Value

Updates = tuple[tuple[str, Expression], ...]


@dataclass(frozen=True)
class Command:
    """A command: with the probability of each outcome its updates; what they leave out persists."""

    module: str
    label: str
    guard: Expression
    outcomes: tuple[tuple[Expression, Updates], ...]
    place: Place


@dataclass(frozen=True)
class RewardItem:
    """`value` where `guard` holds; for an action, "" for commands without a label, None for every step."""

    label: str | None
    guard: Expression
    value: Expression
    place: Place


@dataclass(frozen=True)
class Structure:
    """A reward structure."""

    name: str
    items: tuple[RewardItem, ...]


@dataclass(frozen=True)
class Program:
    """See the module's docstring; `first` holds a value for each feature, or `initial` a condition."""

    kind: str
    features: tuple[Feature, ...]
    modules: tuple[tuple[str, tuple[Command, ...]], ...]
    labels: Mapping[str, Expression]
    structures: tuple[Structure, ...]
    first: Mapping[str, Value]
    initial: Expression | None
    parameters: Mapping[str, Fraction]
    constants: Mapping[str, Fraction | bool]
    warnings: tuple[Fault, ...] = ()


def make_program(raw: RawProgram, scan: Scan, settings: Mapping[str, str]) -> Program:
    """The program behind what the parser read, with constants set.

    Raises:
        ModelError: constants without a value, bounds that are no numbers, or numbers too large.
    """
    return _Build(raw, scan, settings).program()


class _Build:
    def __init__(self, raw: RawProgram, scan: Scan, settings: Mapping[str, str]) -> None:
        self.raw, self.scan, self.settings = raw, scan, settings
        self.own = [c for c in raw.constants if c[0] != scan.constant]
        self.definitions = {name: (kind, node) for name, kind, node in self.own}
        self.variables = {variable.name for variable in raw.variables}
        self.values: dict[str, Fraction | bool] = {}
        self.symbols: dict[str, Expression] = {}
        self.parameters: dict[str, Fraction] = {}
        self.warnings: list[Fault] = []
        self.number_of = Translator(raw.nodes, self.value_named)
        self.translate = Translator(raw.nodes, self.symbol_named)

    def fault(self, message: str, place: Place, hint: str = "") -> ModelError:
        return ModelError([Fault(message, hint=hint, line=place[0], column=place[1])])

    # -- constants -----------------------------------------------------------------------------

    def constants(self) -> None:
        missing = [name for name, kind, node in self.own if node is None and name not in self.settings]
        if missing:
            shown = " ".join(f"--set {name}=VALUE" for name in missing[:5])
            listed = ", ".join(missing[:20])
            place = self.scan.constants.get(missing[0], (0, 0))
            raise self.fault(f"constants without a value: {listed}", place, f"give each one: {shown}")
        for name, kind, _ in self.own:
            if name in self.settings:
                self.values[name] = _setting(name, kind, self.settings[name])
                if kind == "double":
                    self.symbols[name] = Parameter(name)
        for name, _, _ in self.own:
            self.value_named(name)
        named = {name for name, symbol in self.symbols.items() if symbol == Parameter(name)}
        self.parameters = {n: Fraction(self.values[n]) for n, _, _ in self.own if n in named}

    def value_named(self, name: str) -> Expression:
        """The value of a constant; what a definition uses is computed first."""
        waiting: list[str] = [name]
        while waiting:
            top = waiting[-1]
            if top in self.values:
                waiting.pop()
                continue
            if top not in self.definitions:
                raise ModelError(f"the name {top[:60]!r} stands where a number is needed")
            kind, node = self.definitions[top]
            assert node is not None, "constants without a value were refused"
            uses = [n for n in self.names_in(node) if n in self.definitions]
            needs = [n for n in uses if n not in self.values]
            if not needs:
                self.values[top] = self.known(
                    self.number_of(node), f"the constant {top}", self.place_of(top)
                )
                if kind == "double":
                    self.symbols[top] = self.translate(node) if uses else Parameter(top)
                waiting.pop()
            elif set(needs) & set(waiting):
                raise self.fault(f"the constant {top} depends on itself", self.place_of(top))
            else:
                waiting += needs
        return Constant(self.values[name])

    def names_in(self, root: int) -> list[str]:
        found: dict[str, None] = {}
        seen = {root}
        stack = [root]
        while stack:
            kind, *rest = self.raw.nodes[stack.pop()]
            if kind == "name":
                found[rest[0]] = None
            elif kind not in ("int", "rational", "bool"):
                stack += [part for part in rest if part not in seen]
                seen.update(rest)
        return list(found)

    def place_of(self, name: str) -> Place:
        return self.scan.constants.get(name, (0, 0))

    def known(self, expression: Expression, what: str, place: Place) -> Fraction | bool:
        if isinstance(expression, Constant) and not isinstance(expression.value, str):
            return expression.value
        raise self.fault(f"{what} has no value: {str(expression)[:200]}", place)

    def symbol_named(self, name: str) -> Expression:
        """What a name in an expression stands for."""
        if name in self.variables:
            return Reference(name)
        if name in self.symbols:
            return self.symbols[name]
        return self.value_named(name)

    # -- the rest --------------------------------------------------------------------------------

    def program(self) -> Program:
        self.constants()
        features, first = self.features()
        own = self.scan.module
        modules = tuple(
            (name, tuple(self.command(name, index, command) for index, command in enumerate(commands)))
            for name, commands in self.raw.modules
            if name != own
        )
        items = [c for name, commands in self.raw.modules if name == own for c in commands]
        structures: list[Structure] = []
        for text in self.scan.structures:
            count = 2 * len(text.items)
            taken, items = items[:count], items[count:]
            if len(taken) < count:
                raise self.fault("a reward structure that the parser reads otherwise", text.place)
            rows = tuple(
                RewardItem(t.label, self.translate(guard.guard), self.reward(value.guard, t.place), t.place)
                for t, guard, value in zip(text.items, taken[::2], taken[1::2], strict=True)
            )
            structures.append(Structure(text.name, rows))
        self.check_labels(modules)
        return Program(
            self.scan.kind or "mdp", features, modules,
            {name: self.translate(node) for name, node in self.raw.labels}, tuple(structures), first,
            None if self.raw.initial is None else self.translate(self.raw.initial),
            self.parameters, self.values, tuple(self.warnings),
        )  # fmt: skip

    def reward(self, node: int, place: Place) -> Expression:
        """The value v behind the guard `v = c`; see `Scan.for_the_parser`."""
        kind, *parts = self.raw.nodes[node]
        if kind != "EQUAL" or self.raw.nodes[parts[1]] != ("name", self.scan.constant):
            raise self.fault("a reward that the parser reads otherwise", place)
        return self.translate(parts[0])

    def check_labels(self, modules: tuple[tuple[str, tuple[Command, ...]], ...]) -> None:
        known = {c.label for _, commands in modules for c in commands}
        texts: list[StructureText] = self.scan.structures
        for item in (item for text in texts for item in text.items):
            if item.label and item.label not in known:
                listed = ", ".join(sorted(known - {""})[:20]) or "none"
                raise self.fault(
                    f"a reward of the action {item.label[:60]!r}, which no command has", item.place,
                    f"actions are {listed}",
                )  # fmt: skip

    def features(self) -> tuple[tuple[Feature, ...], dict[str, Value]]:
        features: list[Feature] = []
        first: dict[str, Value] = {}
        order = {name: index for index, name in enumerate(self.scan.variables)}
        groups: dict[str | None, list[Feature]] = {}
        for variable in self.raw.variables:
            place = self.scan.variables.get(
                variable.name, self.scan.renamed.get(variable.module or "", (0, 0))
            )
            values: tuple[Value, ...] = (False, True)
            if variable.low is not None and variable.high is not None:
                low = self.bound(variable.low, variable.name, place)
                high = self.bound(variable.high, variable.name, place)
                if not low <= high < low + MAXIMUM_VALUES:
                    raise self.fault(f"{variable.name} has the bounds [{low}..{high}]", place,
                                     f"it may have from 1 to {MAXIMUM_VALUES:,} values")  # fmt: skip
                values = tuple(range(low, high + 1))
            feature = Feature(variable.name, values)
            groups.setdefault(variable.module, []).append(feature)
            if variable.first is None:
                continue
            value = self.known(self.number_of(variable.first), f"the first value of {variable.name}", place)
            index = feature.index(value)
            if index is None:
                raise self.fault(f"{variable.name} starts at {value}, which it can't have", place)
            first[variable.name] = values[index]
        for group in groups.values():
            features += sorted(group, key=lambda f: order.get(f.name, len(order)))
        return tuple(features), first

    def bound(self, node: int, name: str, place: Place) -> int:
        value = self.known(self.number_of(node), f"a bound of {name}", place)
        if isinstance(value, bool) or value.denominator != 1:
            raise self.fault(f"a bound of {name} is {value}, no integer", place)
        return int(value)

    def command(self, module: str, index: int, raw: object) -> Command:
        from factored_polca.formats.prism_process import RawCommand

        assert isinstance(raw, RawCommand)
        places = self.scan.commands.get(module, [])
        place = self.scan.renamed.get(module) or (places[index] if index < len(places) else (0, 0))
        outcomes = [
            (self.translate(chance), tuple((name, self.translate(value)) for name, value in updates))
            for chance, updates in raw.outcomes
        ]
        return Command(module, raw.label, self.translate(raw.guard), self.exact(outcomes, place), place)

    def exact(
        self, outcomes: list[tuple[Expression, Updates]], place: Place
    ) -> tuple[tuple[Expression, Updates], ...]:
        """Outcomes whose probabilities are numbers and miss 1 by rounding, divided by their sum."""
        chances = [
            c.value for c, _ in outcomes if isinstance(c, Constant) and isinstance(c.value, Fraction)
        ]
        total = sum(chances, Fraction(0))
        if len(chances) < len(outcomes) or total == 1 or abs(total - 1) >= CLOSE:
            return tuple(outcomes)
        self.warnings.append(Fault(
            f"probabilities that sum to {float(total):.12g} were divided by their sum", line=place[0],
            column=place[1], severity="warning",
        ))  # fmt: skip
        return tuple(
            (Constant(q / total), updates) for q, (_, updates) in zip(chances, outcomes, strict=True)
        )


CLOSE = Fraction(1, 10_000)
"""A row of other people's files may miss 1 by less."""


def _setting(name: str, kind: str, text: str) -> Fraction | bool:
    """The value of a constant that is set."""
    if kind == "bool":
        if text.lower() not in ("true", "false"):
            raise ModelError(f"{name} is a bool constant: true or false, not {text[:40]!r}")
        return text.lower() == "true"
    try:
        over, slash, under = text.strip().partition("/")
        sign = -1 if over.startswith("-") else 1
        value = sign * number(over.removeprefix("-"))
        if slash:
            value /= number(under)
    except (ValueError, ZeroDivisionError):
        raise ModelError(f"{name} is a number such as 3, 0.25 or 1/3, not {text[:40]!r}") from None
    if kind == "int" and value.denominator != 1:
        raise ModelError(f"{name} is an int constant, not {text[:40]!r}")
    return value
