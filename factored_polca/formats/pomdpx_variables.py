"""The variables that a POMDPX file declares, and what stands for them in a model.

    <StateVar vnamePrev="x_0" vnameCurr="x_1">   a feature x: x_0 is x now, x_1 is x next
    <ObsVar vname="o">                           an observation feature
    <ActionVar vname="a">                        one part of an action
    <RewardVar vname="r"/>                       a term of the reward

The feature is called after vnamePrev, without a trailing `_0` where no other variable has that name.
Values are listed, or counted: `NumValues` n stands for s0 .. s(n-1), o0 .. or a0 .. .
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import prod
from typing import Final, Literal

from factored_polca.formats.pomdpx_document import (
    Element,
    Faults,
    Place,
    check_attributes,
    error,
    no_children,
    no_text,
    quoted,
)
from factored_polca.models.check import MAXIMUM_FEATURES, MAXIMUM_VALUES
from factored_polca.models.expressions import Reference

MAXIMUM_NAME: Final = 255
"""Characters in one name."""
MAXIMUM_ACTIONS: Final = 10_000
"""Actions of a model: the product of the values of its action variables."""

Kind = Literal["now", "next", "observation", "action", "reward"]

_PREFIXES: Final[Mapping[str, str]] = {"StateVar": "s", "ObsVar": "o", "ActionVar": "a"}
_ATTRIBUTES: Final[Mapping[str, tuple[str, ...]]] = {
    "StateVar": ("vnamePrev", "vnameCurr"),
    "ObsVar": ("vname",),
    "ActionVar": ("vname",),
    "RewardVar": ("vname",),
}
_TRUTH: Final[Mapping[str, bool]] = {"true": True, "1": True, "false": False, "0": False}


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """One name of the file: a state variable has two, now and next."""

    name: str
    kind: Kind
    reference: Reference
    values: tuple[str, ...]
    index: Mapping[str, int]  # value -> its number
    counted: bool  # by NumValues: the number alone stands for the value, too
    place: Place

    def number_of(self, word: str) -> int | None:
        """The number of the value `word`, or None."""
        found = self.index.get(word)
        if found is None and self.counted and word.isascii() and word.isdigit() and len(word) < 10:
            number = int(word)
            return number if number < len(self.values) else None
        return found

    def listed(self) -> str:
        """Its values, for a message."""
        shown = ", ".join(self.values[:12])
        return shown + (", ..." if len(self.values) > 12 else "")


@dataclass(frozen=True, slots=True, eq=False)
class StateVariable:
    """A feature: its name in the model, and its two names in the file."""

    feature: str
    now: Variable
    next: Variable
    observed: bool


@dataclass
class Variables:
    """All variables of a file, each kind in the order of the file."""

    named: dict[str, Variable] = field(default_factory=dict)
    states: list[StateVariable] = field(default_factory=list)
    observations: list[Variable] = field(default_factory=list)
    actions: list[Variable] = field(default_factory=list)
    rewards: list[Variable] = field(default_factory=list)

    def values(self) -> dict[str, tuple[str, ...]]:
        """The values of each reference's name."""
        kinds = [[state.now for state in self.states], self.observations, self.actions]
        return {v.reference.name: v.values for variables in kinds for v in variables}

    def joint_actions(self) -> list[tuple[str, dict[str, str]]]:
        """Each action's name and the value of each action variable."""
        found = []
        for values in product(*(variable.values for variable in self.actions)):
            choice = {v.reference.name: value for v, value in zip(self.actions, values, strict=True)}
            found.append((",".join(values), choice))
        return found

    def listed(self, kinds: Sequence[Kind]) -> str:
        """The names of these kinds, for a message."""
        names = [v.name for v in self.named.values() if v.kind in kinds]
        return (", ".join(names[:12]) + (", ..." if len(names) > 12 else "")) or "none"


@dataclass(frozen=True, slots=True)
class _Declaration:
    """One element of <Variable>, before names are settled."""

    element: Element
    names: tuple[str, ...]
    values: tuple[str, ...]
    counted: bool
    observed: bool = False


def read_variables(section: Element, faults: Faults) -> Variables:
    """The variables that <Variable> declares.

    Raises:
        ModelError: faults that leave nothing to go on with; lesser ones are added to `faults`.
    """
    declarations: list[_Declaration] = []
    for element in section.children:
        with faults.gathering():
            declarations.append(_declaration(element))
    names = Counter(name for declaration in declarations for name in declaration.names)
    for declaration in declarations:
        for name in dict.fromkeys(declaration.names):
            if names[name] > 1:
                names[name] = 1
                faults.add(f"the name {quoted(name)} is declared twice", declaration.element.place,
                           "vnamePrev, vnameCurr and vname are all different")  # fmt: skip
    kinds = Counter(declaration.element.name for declaration in declarations)
    for kind, meaning in (("StateVar", "state"), ("ActionVar", "action"), ("RewardVar", "reward")):
        if not kinds[kind] and not any(element.name == kind for element in section.children):
            faults.add(f"there is no {kind}", section.place,
                       f"a model has a {meaning} variable or more")  # fmt: skip
    if kinds["StateVar"] + kinds["ObsVar"] > MAXIMUM_FEATURES:
        faults.add(f"more than {MAXIMUM_FEATURES} variables", section.place)
    faults.raise_if_any()
    variables = _settled(declarations, names)
    _check_actions(variables, section.place, faults)
    faults.raise_if_any()
    return variables


def _check_actions(variables: Variables, place: Place, faults: Faults) -> None:
    count = prod(len(variable.values) for variable in variables.actions)
    if count > MAXIMUM_ACTIONS:
        faults.add(f"the action variables have {count} joint values", variables.actions[0].place,
                   f"at most {MAXIMUM_ACTIONS} actions are read")  # fmt: skip
        return
    hint = "values of several action variables are joined by commas: use none in them"
    for name, times in Counter(name for name, _ in variables.joint_actions()).items():
        if times > 1:
            faults.add(f"{times} joint actions would be called {quoted(name)}", place, hint)


def _settled(declarations: Sequence[_Declaration], declared: Mapping[str, int]) -> Variables:
    """The variables, once all names are known to be different."""
    variables = Variables()
    stems = Counter(_stem(d.names[0]) for d in declarations if d.element.name == "StateVar")
    for d in declarations:
        index = {value: number for number, value in enumerate(d.values)}

        def variable(name: str, kind: Kind, reference: Reference, d: _Declaration = d,
                     index: Mapping[str, int] = index) -> Variable:  # fmt: skip
            made = Variable(name, kind, reference, d.values, index, d.counted, d.element.place)
            variables.named[name] = made
            return made

        match d.element.name:
            case "StateVar":
                stem = _stem(d.names[0])
                feature = d.names[0] if stem in declared or stems[stem] > 1 else stem
                now = variable(d.names[0], "now", Reference(feature))
                following = variable(d.names[1], "next", Reference(feature, primed=True))
                variables.states.append(StateVariable(feature, now, following, d.observed))
            case "ObsVar":
                variables.observations.append(variable(d.names[0], "observation", Reference(d.names[0])))
            case "ActionVar":
                variables.actions.append(variable(d.names[0], "action", Reference(d.names[0])))
            case _:
                variables.rewards.append(variable(d.names[0], "reward", Reference(d.names[0])))
    return variables


def _stem(name: str) -> str:
    return name[:-2] if name.endswith("_0") and len(name) > 2 else name


def _declaration(element: Element) -> _Declaration:
    needed = _ATTRIBUTES.get(element.name)
    if needed is None:
        raise error(f"<{element.name}> is no kind of variable", element.place,
                    f"kinds are {', '.join(_ATTRIBUTES)}")  # fmt: skip
    allowed = {*needed, "fullyObs"} if element.name == "StateVar" else set(needed)
    check_attributes(element, allowed, needed)
    no_text(element)
    names = tuple(element.attributes[key].strip() for key in needed)
    for name in names:
        check_name(name, element.place)
        if name == "null":
            raise error("no variable can be called 'null'", element.place,
                        "in <Parent> it says that there is no parent")  # fmt: skip
    if element.name == "RewardVar":
        for child in element.children:
            raise error("a reward variable has no values", child.place, '<RewardVar vname="..."/>')
        return _Declaration(element, names, (), False)
    observed = element.attributes.get("fullyObs", "false").strip()
    if observed not in _TRUTH:
        raise error(f"fullyObs is {quoted(observed)}", element.place, "it is 'true' or 'false'")
    values, counted = _values(element, names[0])
    return _Declaration(element, names, values, counted, _TRUTH[observed])


def _values(element: Element, name: str) -> tuple[tuple[str, ...], bool]:
    """The values of a variable, and whether they were counted rather than listed."""
    hint = "<ValueEnum>left right</ValueEnum>, or <NumValues>2</NumValues>"
    if len(element.children) != 1:
        count = "no" if not element.children else "two lists of"
        raise error(f"{quoted(name)} has {count} values", element.place, hint)
    child = element.children[0]
    if child.name not in ("ValueEnum", "NumValues"):
        raise error(f"<{child.name}> inside <{element.name}>", child.place, hint)
    check_attributes(child, ())
    no_children(child)
    words = child.words()
    if child.name == "NumValues":
        if len(words) != 1 or not (words[0].isascii() and words[0].isdigit() and int(words[0][:10]) > 0):
            raise error(
                f"NumValues is {quoted(' '.join(words))}", child.place, "a whole number, at least 1"
            )
        if len(words[0]) > 9 or int(words[0]) > MAXIMUM_VALUES:
            raise error(f"{quoted(name)} has more than {MAXIMUM_VALUES} values", child.place)
        return tuple(f"{_PREFIXES[element.name]}{i}" for i in range(int(words[0]))), True
    if not words:
        raise error(f"{quoted(name)} has no values", child.place, hint)
    if len(words) > MAXIMUM_VALUES:
        raise error(f"{quoted(name)} has more than {MAXIMUM_VALUES} values", child.place)
    seen: set[str] = set()
    for number, word in enumerate(words):
        place = child.place_of_word(number) if word in seen or not _plain(word) else child.place
        check_name(word, place)
        if word in ("*", "-"):
            raise error(f"{word!r} can't be a value: in tables it stands for all values", place)
        if word in seen:
            raise error(f"{quoted(name)} lists the value {quoted(word)} twice", place)
        seen.add(word)
    return tuple(words), False


def _plain(word: str) -> bool:
    return word not in ("*", "-") and len(word) <= MAXIMUM_NAME and not _forbidden(word)


def _forbidden(name: str) -> list[str]:
    return [c for c in name if c.isspace() or not c.isprintable() or c in '`"']


def check_name(name: str, place: Place) -> None:
    """Refuse what can't be a name.

    Raises:
        ModelError: empty, too long, or with a space, a quote or a character that can't be shown.
    """
    if not name:
        raise error("an empty name", place)
    if len(name) > MAXIMUM_NAME:
        raise error(f"a name of more than {MAXIMUM_NAME} characters", place)
    if _forbidden(name):
        what = "a space, a quote or a character that can't be shown"
        raise error(f"the name {quoted(name)} has {what}", place,
                    "use letters, digits, '_' and '-'")  # fmt: skip
