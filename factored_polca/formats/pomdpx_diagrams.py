"""Decision diagrams of a POMDPX file, and distributions from functions of the parents and the variable.

    <DAG> or <SubDAGTemplate id="..."> ::= <Node> | <SubDAG> | <Terminal>
    <Node var="x"> {<Edge val="v"> <Node> | <SubDAG> | <Terminal> </Edge>} </Node>

A diagram is a function f of the parents and of the variables v_1..v_m that a <CondProb> is about; an
edge that is not there leads to 0.  The shorthands are functions too:

    deterministic var=x val=v    1 where x = v, else 0
    persistent var=x_1           1 where x_1 = x_0, else 0
    uniform var=x                1/n, n the number of values of x
    template idref=t             the template's function

Joint probabilities of several variables become conditional ones by the chain rule

    P(v_k | v_1..v_(k-1), parents) = M_k / M_(k-1),  M_m = f,  M_(k-1) = sum of M_k over v_k.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from typing import Final

import networkx as nx

from factored_polca.formats.pomdpx_document import (
    Element,
    Faults,
    Place,
    check_attributes,
    error,
    no_children,
    no_text,
    only,
    quoted,
)
from factored_polca.formats.pomdpx_rows import Context, Numbers, Rows, read_number
from factored_polca.formats.pomdpx_variables import Variable
from factored_polca.formats.spudd_trees import (
    MAXIMUM_DEPTH,
    MAXIMUM_EXPANSION,
    ExpansionLimit,
    Forest,
    TreeLimit,
    reason,
)
from factored_polca.models.expressions import Constant, Expression, Switch

_BODY: Final = ("Node", "SubDAG", "Terminal")
_SUBDAG: Final = {
    "deterministic": ("var", "val"),
    "persistent": ("var",),
    "uniform": ("var",),
    "template": ("idref",),
}


@dataclass
class Diagram:
    """Reads one <Parameter type="DD"> as a function in the forest.

    `variables` are the parents, then those the function is about; of the latter `children` have
    their probabilities here, 0 for rewards.  `shortcuts` maps a node that is a distribution of the
    only child, whatever its other variables are, to that distribution.
    """

    rows: Rows
    variables: Sequence[Variable]
    children: int
    numbers: Numbers
    faults: Faults
    earlier: dict[str, Variable]  # next -> now, of one feature
    shortcuts: dict[int, Expression] = field(default_factory=dict)
    templates: dict[str, Expression] = field(default_factory=dict)

    @property
    def forest(self) -> Forest:
        """Where the function lives."""
        return self.rows.forest

    def function(self, parameter: Element) -> Expression:
        """The function that the <DAG> of `parameter` describes.

        Raises:
            ModelError: it is not right; names the element.
        """
        parts = list(only(parameter, ("DAG", "SubDAGTemplate")))
        diagrams = [part for part in parts if part.name == "DAG"]
        if len(diagrams) != 1:
            place = diagrams[1].place if diagrams else parameter.place
            raise error(f"{len(diagrams)} diagrams", place, 'one <DAG> in <Parameter type="DD">')
        for name, body in self._ordered([part for part in parts if part.name == "SubDAGTemplate"]):
            self.templates[name] = self._body(body)
        check_attributes(diagrams[0], ())
        return self._body(_only_child(diagrams[0]))

    def _ordered(self, templates: Sequence[Element]) -> Iterator[tuple[str, Element]]:
        """Names and bodies of the templates, each after those that it uses."""
        found: dict[str, Element] = {}
        for template in templates:
            check_attributes(template, ("id",), ("id",))
            name = template.attributes["id"].strip()
            if name in found:
                raise error(f"two templates have the id {quoted(name)}", template.place)
            found[name] = _only_child(template)
        graph = nx.DiGraph()
        graph.add_nodes_from(found)
        for name, body in found.items():
            for part in _downwards(body):
                used = part.attributes.get("idref", "").strip() if part.name == "SubDAG" else ""
                if used in found:
                    graph.add_edge(used, name)
        if not nx.is_directed_acyclic_graph(graph):
            cycle = [edge[0] for edge in nx.find_cycle(graph)]
            circle = " -> ".join(quoted(name) for name in [*cycle, cycle[0]])
            raise error(f"templates use each other in a circle: {circle}", found[cycle[0]].place,
                        "a template may use others only acyclically")  # fmt: skip
        for name in nx.lexicographical_topological_sort(graph):
            yield name, found[name]

    def _body(self, body: Element) -> Expression:
        """The function of a <Node>, <SubDAG> or <Terminal>, built from the leaves up."""
        if body.name not in _BODY:
            raise error(f"<{body.name}> where a diagram begins", body.place,
                        f"it is one of {', '.join(f'<{name}>' for name in _BODY)}")  # fmt: skip
        built: list[Expression] = []  # of the elements whose parent has not been reached, last first
        for element in reversed(list(_downwards(body))):
            self.forest.count(1)
            match element.name:
                case "Node":
                    edges = [built.pop() for _ in element.children]
                    built.append(self._node(element, edges))
                case "Edge":
                    _only_child(element)
                case "SubDAG":
                    built.append(self._shorthand(element))
                case "Terminal":
                    built.append(self._terminal(element))
                case other:
                    raise error(f"<{other}> inside a diagram", element.place,
                                "it holds <Node>, <Edge>, <SubDAG> and <Terminal>")  # fmt: skip
        (result,) = built
        return result

    def _node(self, element: Element, below: Sequence[Expression]) -> Expression:
        check_attributes(element, ("var",), ("var",))
        variable = self._variable(element)
        edges: dict[int, Expression] = {}
        for edge, function in zip(only(element, ("Edge",)), below, strict=True):
            check_attributes(edge, ("val",), ("val",))
            value = self._value(edge, variable)
            if value in edges:
                raise error(f"a second edge for {quoted(variable.values[value])}", edge.place)
            edges[value] = function
        if not edges:
            raise error(f"the node {quoted(variable.name)} has no <Edge>", element.place)
        zero = self.forest.constant(Fraction(0))
        cases = [edges.get(value, zero) for value in range(len(variable.values))]
        return self.forest.switch(variable.reference, cases)

    def _terminal(self, element: Element) -> Expression:
        check_attributes(element, ())
        no_children(element)
        words = element.words()
        if len(words) != 1:
            raise error("a <Terminal> holds one number", element.place)
        place = element.place_of_word(0)
        value = read_number(self.numbers, words[0], place, probability=bool(self.children))
        return self.forest.constant(value)

    def _shorthand(self, element: Element) -> Expression:
        kind = element.attributes.get("type", "").strip()
        needed = _SUBDAG.get(kind)
        if needed is None:
            raise error(f"the type of <SubDAG> is {quoted(kind)}", element.place,
                        f"types are {', '.join(_SUBDAG)}")  # fmt: skip
        check_attributes(element, ("type", *needed), needed)
        no_text(element)
        no_children(element)
        if kind == "template":
            name = element.attributes["idref"].strip()
            if name not in self.templates:
                listed = ", ".join(sorted(self.templates)[:12]) or "none"
                raise error(f"there is no template {quoted(name)}", element.place,
                            f"templates of this <Parameter> are: {listed}")  # fmt: skip
            return self.templates[name]
        variable = self._variable(element)
        about = self.variables[-self.children :] if self.children else self.variables
        if variable not in about:
            raise error(f"'{kind}' says nothing of {quoted(variable.name)}, a parent here", element.place,
                        f"var is one of {', '.join(v.name for v in about[:12])}")  # fmt: skip
        function, meaning = self._function(kind, variable, element)
        if self.children == 1:
            self.shortcuts[id(function)] = meaning
        return function

    def _function(self, kind: str, variable: Variable, element: Element) -> tuple[Expression, Expression]:
        """The function of a shorthand, and the distribution of `variable` that it is."""
        forest = self.forest
        if kind == "uniform":
            share = forest.constant(Fraction(1, len(variable.values)))
            return share, self.rows.uniform(variable)
        if kind == "deterministic":
            other = forest.constant(variable.values[self._value(element, variable)])
        else:
            earlier = self.earlier.get(variable.name)
            if earlier is None or earlier not in self.variables:
                needed = quoted(earlier.name) if earlier else "its variable before the step"
                raise error(f"'persistent' of {quoted(variable.name)} without {needed}", element.place,
                            "var is a vnameCurr, and <Parent> lists its vnamePrev")  # fmt: skip
            other = forest.reference(earlier.reference)
        same = forest.operation("equal", (forest.reference(variable.reference), other))
        one, zero = forest.constant(Fraction(1)), forest.constant(Fraction(0))
        return forest.conditional(same, one, zero), other

    def _variable(self, element: Element) -> Variable:
        name = element.attributes["var"].strip()
        for variable in self.variables:
            if variable.name == name:
                return variable
        listed = ", ".join(variable.name for variable in self.variables[:12])
        raise error(f"{quoted(name)} is not among the variables of this function", element.place,
                    f"<Parent> and <Var> list {listed}")  # fmt: skip

    def _value(self, element: Element, variable: Variable) -> int:
        word = element.attributes["val"].strip()
        value = variable.number_of(word)
        if value is None:
            raise error(f"{quoted(word)} is no value of {quoted(variable.name)}", element.place,
                        f"its values are {variable.listed()}")  # fmt: skip
        return value


def _only_child(element: Element) -> Element:
    no_text(element)
    if len(element.children) != 1:
        count = len(element.children) or "nothing"
        raise error(f"<{element.name}> holds {count}{' elements' if element.children else ''}",
                    element.place, "one <Node>, <SubDAG> or <Terminal>")  # fmt: skip
    child = element.children[0]
    if child.name not in _BODY:
        raise error(f"<{child.name}> inside <{element.name}>", child.place,
                    "one <Node>, <SubDAG> or <Terminal>")  # fmt: skip
    return child


def _downwards(body: Element) -> Iterator[Element]:
    """`body` and all elements inside it, each before those inside it, first to last."""
    stack = [body]
    while stack:
        element = stack.pop()
        yield element
        stack.extend(reversed(element.children))


@dataclass
class Distributions:
    """Distributions of `target` from a function of the parents and of `target`."""

    rows: Rows
    target: Variable
    parents: Sequence[Variable]
    place: Place
    normalise: bool = False
    shortcuts: dict[int, Expression] = field(default_factory=dict)
    memo: dict[int, Expression] = field(default_factory=dict)
    asked: dict[int, Variable] = field(init=False)  # bit in a support -> parent
    actions: int = field(init=False)
    kept: int = field(init=False)

    def __post_init__(self) -> None:
        self.asked = {self.rows.forest.bit(variable.reference): variable for variable in self.parents}
        self.actions = sum(bit for bit, variable in self.asked.items() if variable.kind == "action")
        self.kept = self.rows.forest.bit(self.target.reference)

    def tree(self, function: Expression) -> Expression:
        """The decision tree over the parents, action variables first, whose leaves are distributions.

        Raises:
            TreeLimit: it needs more steps, nodes or levels than the limits allow.
        """
        return _limited(self.rows.forest, lambda: self._visit(function, ()))

    def _visit(self, function: Expression, context: Context) -> Expression:
        known = self.shortcuts.get(id(function), self.memo.get(id(function)))
        if known is not None:
            return known
        forest = self.rows.forest
        actions = forest.support(function) & self.actions
        if actions:
            variable = self.asked[actions & -actions]
        else:
            reference = forest.first_reference(function, self.kept)
            if reference is None:
                known = self._row(function, context)
                self.memo[id(function)] = known
                return known
            variable = self.asked[forest.bit(reference)]
        if len(context) >= MAXIMUM_DEPTH:
            raise TreeLimit(f"trees nested deeper than {MAXIMUM_DEPTH} levels")
        cases = []
        for number, value in enumerate(variable.values):
            below = forest.restrict(function, variable.reference, value)
            cases.append(self._visit(below, (*context, (variable, number))))
        known = self.memo[id(function)] = self.rows.switch(variable, cases)
        return known

    def _row(self, function: Expression, context: Context) -> Expression:
        forest = self.rows.forest
        forest.count(len(self.target.values))
        if isinstance(function, Switch):
            cases = [case for _, case in function.cases]
        elif isinstance(function, Constant):
            cases = [function] * len(self.target.values)
        else:
            cases = [forest.restrict(function, self.target.reference, v) for v in self.target.values]
        weights: dict[int, Fraction] = {}
        for value, case in enumerate(cases):
            if isinstance(case, Switch):  # the variable is asked twice on one path
                case = forest.restrict(case, self.target.reference, self.target.values[value])
            if not (isinstance(case, Constant) and isinstance(case.value, Fraction)):
                raise error(f"no probability of {quoted(self.target.name)}: {reason(case)}", self.place)
            weights[value] = case.value
        return self.rows.row(weights, self.target, context, self.place, normalise=self.normalise)


def chain(
    rows: Rows,
    function: Expression,
    children: Sequence[Variable],
    parents: Sequence[Variable],
    place: Place,
) -> list[tuple[Variable, Expression]]:
    """Each of `children` with its distribution given the parents and the children before it.

    Raises:
        TreeLimit: the sums need more steps, nodes or levels than the limits allow.
    """
    forest = rows.forest
    found: list[tuple[Variable, Expression]] = []
    for number in reversed(range(len(children))):
        child = children[number]
        scope = [*parents, *children[:number]]
        distributions = Distributions(rows, child, scope, place, normalise=number > 0)
        found.append((child, distributions.tree(function)))
        function = _limited(forest, partial(_summed, forest, function, child))
    return found[::-1]


def _summed(forest: Forest, function: Expression, variable: Variable) -> Expression:
    """The sum of `function` over the values of `variable`."""
    parts = [forest.restrict(function, variable.reference, value) for value in variable.values]
    return forest.operation("add", parts) if len(parts) > 1 else parts[0]


def _limited(forest: Forest, work: Callable[[], Expression]) -> Expression:
    try:
        return forest.limited(work)
    except ExpansionLimit:
        raise TreeLimit(f"one function needs more than {MAXIMUM_EXPANSION} steps") from None
