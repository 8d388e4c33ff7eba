"""Reader of POMDPX; the format is described in `factored_polca.formats.pomdpx`.

The variables are read first, wherever they stand.  Then each <CondProb> becomes one decision tree
(for joint probabilities one for each variable), action variables decided first, and each action
takes its cofactor.  Everything that strangers can make large is counted by one `Forest`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.pomdpx_assembly import Assembly
from factored_polca.formats.pomdpx_diagrams import Diagram, Distributions, chain
from factored_polca.formats.pomdpx_document import (
    Element,
    Faults,
    Place,
    check_attributes,
    error,
    fault,
    no_children,
    only,
    parse,
    quoted,
)
from factored_polca.formats.pomdpx_rows import Numbers, Rows, read_number
from factored_polca.formats.pomdpx_tables import Table, TableReader
from factored_polca.formats.pomdpx_variables import Kind, Variable, read_variables
from factored_polca.formats.spudd_trees import Forest, TreeLimit
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Expression
from factored_polca.models.features import Feature
from factored_polca.models.model import Model, Observation, replace_fields

MAXIMUM_HORIZON: Final = 10**9

_ROOT: Final = "pomdpx"
_HEADER: Final = ("Discount", "Variable", "Horizon")
_FUNCTIONS: Final = ("InitialStateBelief", "StateTransitionFunction", "ObsFunction", "RewardFunction")
_PARTS: Final = ("Description", *_HEADER, *_FUNCTIONS)
_ATTRIBUTES: Final = ("version", "id")

_ABOUT: Final[Mapping[str, tuple[Kind, ...]]] = {
    "InitialStateBelief": ("now",),
    "StateTransitionFunction": ("next",),
    "ObsFunction": ("observation",),
    "RewardFunction": ("reward",),
}
"""What a function may be about, and below what it may depend on."""
_GIVEN: Final[Mapping[str, tuple[Kind, ...]]] = {
    "InitialStateBelief": ("now",),
    "StateTransitionFunction": ("action", "now", "next"),
    "ObsFunction": ("action", "now", "next"),
    "RewardFunction": ("action", "now", "next", "observation"),
}


def read_pomdpx_with_warnings(text: str, name: str) -> tuple[Model, tuple[Fault, ...]]:
    """The model that the POMDPX document `text` describes, called `name`, and what a careful reader
    should know.

    Warnings tell of rows divided by sums near 1, of attributes that are not read, and of an initial
    belief that is not given.

    Raises:
        ModelError: the text is not right, or asks for more work than the limits allow; every fault
            has a line and a column.
    """
    reader = _Reader(parse(text))
    try:
        return reader.model(name), tuple(reader.warnings)
    except TreeLimit as limit:
        problem = fault(f"reading takes too much work: {limit}", reader.place,
                        "name fewer variables with a value or '-' in one function")  # fmt: skip
        raise ModelError([*reader.faults.found, problem]) from None


@dataclass(frozen=True, slots=True)
class _Function:
    """A <CondProb> or <Func>: what it is about, what it depends on, and its table or diagram."""

    about: tuple[Variable, ...]
    given: tuple[Variable, ...]
    parameter: Element
    diagram: bool
    place: Place


@dataclass
class _Reader:
    root: Element
    faults: Faults = field(default_factory=Faults)
    warnings: list[Fault] = field(default_factory=list)
    place: Place = field(default=Place(1, 1))  # of what is being read
    parts: dict[str, Element] = field(default_factory=dict)
    description: list[str] = field(default_factory=list)

    def model(self, name: str) -> Model:
        self._outline()
        self.variables = read_variables(self.parts["Variable"], self.faults)
        self.forest = Forest(self.variables.values())
        self.rows = Rows(self.forest, self.faults)
        self.numbers = Numbers(self.forest)
        with self.faults.gathering():
            discount = self._discount()
        with self.faults.gathering():
            horizon = self._horizon()
        trees = {title: self._section(title) for title in _FUNCTIONS}
        self.faults.raise_if_any()
        assembly = Assembly(self.forest, self.variables, self.faults)
        initial = assembly.initial(trees["InitialStateBelief"], self.root.place)
        effects, senses = trees["StateTransitionFunction"], trees["ObsFunction"]
        place = self.parts["StateTransitionFunction"].place
        actions, rewards = assembly.actions(effects, senses, list(trees["RewardFunction"].values()), place)
        self.faults.raise_if_any()
        self.warnings += self.rows.warnings()
        states, channels = self.variables.states, self.variables.observations
        full = all(state.observed for state in states) and not channels
        features = [Feature(s.feature, s.now.values, s.observed and not full) for s in states]
        model = Model(
            name,
            features,
            (),
            discount=discount,
            observability="full" if full else "partial",
            observations=[Observation(o.name, o.values) for o in channels],
            horizon=horizon,
            description=" ".join(self.description),
        )
        # the trees name features by references already: resolving them again would take time only
        return replace_fields(model, actions=tuple(actions), rewards=tuple(rewards), initial=initial)

    # -- the document ------------------------------------------------------------------------

    def _outline(self) -> None:
        root = self.root
        if root.name != _ROOT:
            raise error(f"the document is a <{root.name}>", root.place, "POMDPX begins with <pomdpx>")
        unread = [
            n for n in root.attributes if n not in _ATTRIBUTES and not n.startswith(("xmlns", "xsi:"))
        ]
        if unread:
            message = f"attributes of <pomdpx> that are not read: {', '.join(map(quoted, unread[:5]))}"
            self.warnings.append(fault(message, root.place, severity="warning"))
        for element in only(root, _PARTS):
            with self.faults.gathering():
                check_attributes(element, ())
                if element.name == "Description":
                    no_children(element)
                    self.description += element.words()
                elif element.name in self.parts:
                    raise error(f"a second <{element.name}>", element.place, "it may be given once")
                else:
                    self.parts[element.name] = element
        for name in ("Discount", "Variable"):
            if name not in self.parts:
                self.faults.add(f"there is no <{name}>", root.place, f"<{name}>...</{name}>")
        self.faults.raise_if_any()

    def _number(self, element: Element) -> Fraction:
        no_children(element)
        words = element.words()
        if len(words) != 1:
            raise error(f"<{element.name}> holds one number", element.place)
        return read_number(self.numbers, words[0], element.place_of_word(0), probability=False)

    def _discount(self) -> Fraction:
        element = self.parts["Discount"]
        discount = self._number(element)
        if not 0 <= discount <= 1:
            raise error("the discount is not between 0 and 1", element.place)
        return discount

    def _horizon(self) -> int | None:
        element = self.parts.get("Horizon")
        if element is None:
            return None
        horizon = self._number(element)
        if horizon.denominator != 1 or not 1 <= horizon <= MAXIMUM_HORIZON:
            raise error("the horizon is a whole number of steps, at least 1", element.place)
        return int(horizon)

    # -- functions ---------------------------------------------------------------------------

    def _section(self, title: str) -> dict[Variable, Expression]:
        """The tree of each variable that the section is about."""
        element = self.parts.get(title)
        found: dict[Variable, Expression] = {}
        known = len(self.faults.found)
        if element is not None:
            with self.faults.gathering():
                for part in only(element, (_part(title),)):
                    with self.faults.gathering():
                        self._add(part, title, found)
        complete = element is not None and known == len(self.faults.found)
        place = element.place if element is not None else self.root.place
        needed = [v for v in self.variables.named.values() if v.kind in _ABOUT[title]]
        if title == "InitialStateBelief" and element is None:
            self._no_belief()
        elif element is None and needed:
            self.faults.add(f"there is no <{title}>", place, f"it is about {needed[0].name}")
        elif complete:
            for variable in needed:
                if variable not in found:
                    self.faults.add(f"<{title}> has no function of {quoted(variable.name)}", place,
                                    f"<{_part(title)}><Var>{variable.name}</Var>...")  # fmt: skip
        return found

    def _add(self, part: Element, title: str, found: dict[Variable, Expression]) -> None:
        self.place = part.place
        function = self._function(part, title)
        for variable in function.about:
            if variable in found:
                raise error(f"a second function of {quoted(variable.name)}", part.place)
        found.update(self._trees(function))

    def _no_belief(self) -> None:
        if any(not state.observed for state in self.variables.states):
            self.faults.add("there is no <InitialStateBelief>", self.root.place,
                            "it may be left out where all state variables are fullyObs")  # fmt: skip
        message = "no <InitialStateBelief>: all states are taken to be equally likely at first"
        self.warnings.append(fault(message, self.root.place, severity="warning"))

    def _function(self, element: Element, title: str) -> _Function:
        check_attributes(element, ())
        parts = {part.name: part for part in only(element, ("Var", "Parent", "Parameter"))}
        if len(parts) < 3 or len(element.children) != 3:
            raise error(f"<{element.name}> has one <Var>, one <Parent> and one <Parameter>", element.place)
        about = self._named(parts["Var"], _ABOUT[title])
        given = self._named(parts["Parent"], _GIVEN[title], none="null")
        if not about:
            raise error("<Var> is empty", parts["Var"].place, "name a variable")
        for variable in given:
            if variable in about:
                raise error(f"{quoted(variable.name)} can't depend on itself", parts["Parent"].place)
        if len(about) > 1 and title in ("ObsFunction", "RewardFunction"):
            kind = "observation" if title == "ObsFunction" else "reward"
            raise error(f"one function of several {kind} variables", parts["Var"].place,
                        f"give each its own <{element.name}>")  # fmt: skip
        parameter = parts["Parameter"]
        check_attributes(parameter, ("type",))
        kind = parameter.attributes.get("type", "TBL").strip()
        if kind not in ("TBL", "DD"):
            raise error(f"the type of <Parameter> is {quoted(kind)}", parameter.place,
                        "types are TBL (a table) and DD (a decision diagram)")  # fmt: skip
        return _Function(about, given, parameter, kind == "DD", element.place)

    def _named(self, element: Element, kinds: Sequence[Kind], none: str = "") -> tuple[Variable, ...]:
        check_attributes(element, ())
        no_children(element)
        words = element.words()
        if words == [none]:
            return ()
        found: dict[Variable, None] = {}
        for index, word in enumerate(words):
            variable = self.variables.named.get(word)
            if variable is None or variable.kind not in kinds or variable in found:
                problem = "can't stand here"
                if variable is None:
                    problem = "can't stand beside others" if word == none else "is no variable"
                elif variable in found:
                    problem = "is listed twice"
                raise error(f"{quoted(word)} {problem}", element.place_of_word(index),
                            f"<{element.name}> lists some of: {self.variables.listed(kinds)}")  # fmt: skip
            found[variable] = None
        return tuple(found)

    def _trees(self, function: _Function) -> Iterable[tuple[Variable, Expression]]:
        """Decision trees over what the function depends on, of distributions or of rewards."""
        reward = function.about[0].kind == "reward"
        variables = [*function.given, *(() if reward else function.about)]
        children = 0 if reward else len(function.about)
        shortcuts: dict[int, Expression] = {}
        if function.diagram:
            earlier = {state.next.name: state.now for state in self.variables.states}
            diagram = Diagram(self.rows, variables, children, self.numbers, self.faults, earlier)
            weights = diagram.function(function.parameter)
            shortcuts = diagram.shortcuts
        else:
            known = len(self.faults.found)
            entries = TableReader(variables, children, self.numbers, self.faults).entries(
                function.parameter
            )
            if len(self.faults.found) > known:
                return []
            target = function.about[0] if children == 1 else None
            weights = Table(self.rows, variables, target, entries, function.place).tree()
        if reward or (children == 1 and not function.diagram):
            return [(function.about[0], weights)]
        if children > 1:
            return chain(self.rows, weights, function.about, function.given, function.place)
        only_child = function.about[0]
        distributions = Distributions(
            self.rows, only_child, function.given, function.place, shortcuts=shortcuts
        )
        return [(only_child, distributions.tree(weights))]


def _part(title: str) -> str:
    return "Func" if title == "RewardFunction" else "CondProb"
