"""What a parsed RDDL text declares, as values: fluents, types, definitions, and expressions as one table.

The child process says it as JSON; here every field of that is checked before it is used.  Expressions stay
lifted, with variables such as ?x; `rddl_grounding` grounds them.  pyRDDLGym's own grounder is not used: it
knows neither `switch` nor `Discrete` nor a comparison of objects, and drops state-action-constraints.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final, NoReturn

from factored_polca.formats.rddl_fault import GroundingFault
from factored_polca.models.errors import ModelError
from factored_polca.models.scalars import MAXIMUM_BITS, Scalar

Args = tuple[str, ...]

KINDS: Final = frozenset(
    ["number", "boolean", "name", "fluent", "operator", "aggregate", "if", "switch", "function", "draw"]
) | {"discrete", "discrete_over", "unsupported"}
FLUENTS: Final = frozenset(
    ["non-fluent", "state-fluent", "action-fluent", "interm-fluent", "derived-fluent", "observ-fluent"]
)
MAXIMUM_DEPTH: Final = 150
"""Levels of nesting of one expression, chains of one operator counted once."""
MAXIMUM_DIGITS: Final = 1_000

_NUMBER: Final = re.compile(r"-?(?:[0-9]+|[0-9]*\.[0-9]+)")


@dataclass(frozen=True, slots=True)
class Node:
    """A part of an expression; `parts` are numbers of earlier nodes."""

    kind: str
    offset: int
    text: str
    parts: tuple[int, ...]
    binders: tuple[tuple[str, str], ...]
    labels: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Fluent:
    """A declared fluent; `parameters` are its types, `range` is bool, int, real or a type."""

    name: str
    kind: str
    range: str
    parameters: Args
    default: Scalar | None
    offset: int


@dataclass(frozen=True, slots=True)
class Definition:
    """`name(variables) = expression`; a state-fluent's name has its quote."""

    name: str
    variables: Args
    root: int
    offset: int


@dataclass(frozen=True)
class Lifted:
    """A domain with an instance."""

    domain: str
    instance: str
    requirements: frozenset[str]
    types: Mapping[str, Args]
    fluents: Mapping[str, Fluent]
    nodes: tuple[Node, ...]
    definitions: Mapping[str, Definition]
    reward: int
    terminals: tuple[int, ...]
    preconditions: tuple[int, ...]
    constraints: tuple[int, ...]
    invariants: tuple[int, ...]
    non_fluents: Mapping[tuple[str, Args], Scalar]
    initial: Mapping[tuple[str, Args], Scalar]
    horizon: int | None
    discount: Fraction
    concurrent: int | None
    """How many action-fluents may differ from their defaults; None: all."""

    @property
    def objects(self) -> Mapping[str, str]:
        """object -> its type."""
        return {value: kind for kind, values in self.types.items() for value in values}


def number(text: str) -> Fraction:
    """The exact value of a decimal."""
    if not _NUMBER.fullmatch(text):
        raise ModelError(f"{text[:40]!r} is no number")
    if len(text) > MAXIMUM_DIGITS:
        raise ModelError(f"a number of more than {MAXIMUM_DIGITS} digits")
    value = Fraction(text)
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > MAXIMUM_BITS:
        raise ModelError(f"a number of more than {MAXIMUM_DIGITS} digits")
    return value


def lifted(data: Mapping[str, Any]) -> Lifted:
    """The checked description.

    Raises:
        ModelError: it is not of the form that the child promises, or asks for what can't be.
    """
    nodes = tuple(_node(row, index) for index, row in enumerate(_list(data, "nodes")))
    _refuse_depth(nodes)
    fluents = [_fluent(row) for row in _list(data, "fluents")]
    definitions = [_definition(row, len(nodes)) for row in _list(data, "cpfs")]
    names = [_text(name) for name in _list(data, "names")]
    domain = _text(data.get("domain"))
    _refuse_mismatch(domain, names)
    horizon = data.get("horizon")
    discount = data.get("discount")

    def roots(key: str) -> tuple[int, ...]:
        return tuple(_index(root, len(nodes)) for root in _list(data, key))

    return Lifted(
        domain=domain,
        instance=_text(data.get("instance")),
        requirements=frozenset(_text(word) for word in _list(data, "requirements")),
        types=_types(_list(data, "types")),
        fluents={fluent.name: fluent for fluent in fluents},
        nodes=nodes,
        definitions={definition.name: definition for definition in definitions},
        reward=_index(data.get("reward"), len(nodes)),
        terminals=roots("terminals"),
        preconditions=roots("preconditions"),
        constraints=roots("constraints"),
        invariants=roots("invariants"),
        non_fluents=_assigned(_list(data, "non_fluents")),
        initial=_assigned(_list(data, "initial")),
        horizon=None if horizon in (None, "pos-inf") else _steps(_text(horizon), "horizon"),
        discount=Fraction(1) if discount is None else _discount(number(_text(discount))),
        concurrent=_count(_text(data.get("concurrent"))),
    )


def _broken() -> NoReturn:
    raise ModelError("the parser's answer is not of the expected form")


def _list(data: Mapping[str, Any], key: str) -> list[Any]:
    found = data.get(key)
    return found if isinstance(found, list) else _broken()


def _text(value: object) -> str:
    return value if isinstance(value, str) else _broken()


def _texts(value: object) -> Args:
    return tuple(_text(part) for part in value) if isinstance(value, list) else _broken()


def _integer(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) else _broken()


def _index(value: object, count: int) -> int:
    index = _integer(value)
    return index if 0 <= index < count else _broken()


def _node(row: object, index: int) -> Node:
    if not isinstance(row, list) or len(row) != 6 or not isinstance(row[3], list):
        _broken()
    if _text(row[0]) not in KINDS:
        _broken()
    binders = row[4]
    if not isinstance(binders, list):
        _broken()
    pairs = [_texts(pair) for pair in binders]
    if any(len(pair) != 2 for pair in pairs):
        _broken()
    node = Node(
        row[0], _integer(row[1]), _text(row[2]), tuple(_index(part, index) for part in row[3]),
        tuple((name, kind) for name, kind in pairs), _texts(row[5]),
    )  # fmt: skip
    return node if _well_formed(node) else _broken()


_UNARY: Final = frozenset(["~", "negate", "plus", "Bernoulli", "KronDelta", "DiracDelta"])
_BINARY: Final = frozenset(["=>", "<=>", "==", "~=", "<", "<=", ">", ">=", "/"])
_CHAINS: Final = frozenset(["+", "*", "^", "&", "|"])


def _well_formed(node: Node) -> bool:
    """Whether a node has as many parts, bound variables and labels as its kind asks for."""
    count = len(node.parts)
    match node.kind:
        case "operator" | "draw":
            if node.text in _UNARY:
                return count == 1
            if node.kind == "draw":
                return True
            return count == 2 if node.text in _BINARY else count > 0 and node.text in _CHAINS
        case "if":
            return count == 3
        case "switch":
            return count == 1 + sum(1 if label == "default" else 2 for label in node.labels)
        case "aggregate" | "discrete_over":
            return count == 1 and len(node.binders) > 0
        case "discrete":
            return count == len(node.labels) > 0 and len(node.binders) == 1
        case "fluent" | "function":
            return True
    return count == 0


def _refuse_depth(nodes: Iterable[Node]) -> None:
    depths: list[int] = []
    for node in nodes:
        depths.append(1 + max((depths[part] for part in node.parts), default=0))
        if depths[-1] > MAXIMUM_DEPTH:
            raise ModelError(f"an expression is nested deeper than {MAXIMUM_DEPTH} levels")


def _value(data: object, where: str) -> Scalar:
    pair = _texts(data)
    if len(pair) != 2:
        _broken()
    kind, text = pair
    if kind == "boolean":
        return text == "true"
    try:
        return number(text) if kind == "number" else text
    except ValueError as error:
        raise GroundingFault(f"{where}: {error}", -1) from None


def _fluent(row: object) -> Fluent:
    if not isinstance(row, list) or len(row) != 6 or _text(row[1]) not in FLUENTS:
        _broken()
    default = None if row[4] is None else _value(row[4], f"the default of {_text(row[0])}")
    return Fluent(_text(row[0]), row[1], _text(row[2]), _texts(row[3]), default, _integer(row[5]))


def _definition(row: object, count: int) -> Definition:
    if not isinstance(row, list) or len(row) != 4:
        _broken()
    return Definition(_text(row[0]), _texts(row[1]), _index(row[2], count), _integer(row[3]))


def _types(rows: Iterable[object]) -> dict[str, Args]:
    result: dict[str, Args] = {}
    for row in rows:
        if not isinstance(row, list) or len(row) != 3:
            _broken()
        values = _texts(row[2])
        result[_text(row[0])] = tuple(dict.fromkeys(values))
    return result


def _assigned(rows: Iterable[object]) -> dict[tuple[str, Args], Scalar]:
    result: dict[tuple[str, Args], Scalar] = {}
    for row in rows:
        if not isinstance(row, list) or len(row) != 4 or row[2] is None:
            _broken()
        result[_text(row[0]), _texts(row[1])] = _value(row[2], f"the value given to {_text(row[0])}")
    return result


def _refuse_mismatch(domain: str, names: list[str]) -> None:
    """The instance and the non-fluents must be of this domain, and of each other."""
    if len(names) != 4:
        _broken()
    of_instance, of_non_fluents, wanted, found = names
    for block, name in (("instance", of_instance), ("non-fluents", of_non_fluents)):
        if name and name != domain:
            raise ModelError(f"the {block} block is of the domain {name!r}, not of {domain!r}")
    if wanted and found != "none" and wanted != found:
        raise ModelError(f"the instance asks for the non-fluents {wanted!r}; there are {found!r}")


def _steps(text: str, what: str) -> int:
    steps = number(text)
    if steps.denominator != 1 or not 1 <= steps <= 10**9:
        raise ModelError(f"the {what} is {text}: it is a whole number of steps from 1 on, or pos-inf")
    return int(steps)


def _count(text: str) -> int | None:
    if text == "pos-inf":
        return None
    count = number(text)
    if count.denominator != 1 or count < 0:
        raise ModelError(f"max-nondef-actions is {text}: it is a whole number, or pos-inf")
    return int(count)


def _discount(value: Fraction) -> Fraction:
    if not 0 <= value <= 1:
        raise ModelError("the discount is not between 0 and 1")
    return value
