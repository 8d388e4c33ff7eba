"""The child process that parses RDDL: a program of its own, started by `rddl_process`, never imported.

    python -I rddl_child.py MEMORY_BYTES CPU_SECONDS OUTPUT_BYTES PACKAGES < text

It limits itself, parses the text with pyRDDLGym's grammar, lets `RDDLLiftedModel` check declarations, and
writes one JSON object: what was declared, and all expressions as rows of one table, parts before wholes:

    [kind, offset, text, [numbers of parts], [[variable, type], ...], [label, ...]]

`offset` counts characters of the text (-1: unknown).  A number is the text that the file has, so that 0.1
stays 1/10: pyRDDLGym itself keeps floats.  A fault is {"error": message, "offset": n}.

pyRDDLGym's top package is not run: it would load its simulator, pygame and matplotlib.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MAXIMUM_NODES = 300_000
DECIMAL = re.compile(r"[0-9]*\.[0-9]+")
CHAINS = {"+", "*", "^", "&", "|"}
OTHERS = {"/", "~", "=>", "<=>", "==", "~=", "<", "<=", ">", ">="}
AGGREGATES = {"forall", "exists", "sum", "prod", "avg", "min", "max", "argmin", "argmax"}
MATRICES = {"det", "inverse", "pinverse", "cholesky"}
ONCE = {
    "CPFS": "cpfs", "CDFS": "cpfs", "PVARIABLES": "pvariables", "TYPES": "types", "REWARD": "reward",
    "TERMINATION": "termination", "ACTION_PRECONDITIONS": "action-preconditions",
    "STATE_ACTION_CONSTRAINTS": "state-action-constraints", "STATE_INVARIANTS": "state-invariants",
    "INIT_STATE": "init-state", "MAX_NONDEF_ACTIONS": "max-nondef-actions", "DISCOUNT": "discount",
    "HORIZON": "horizon",
}  # fmt: skip
"""Sections that may stand once; the grammar would silently keep the last."""


class Name(str):
    """A name that knows where it stands."""

    offset: int


class Decimal(float):
    """A decimal that keeps its text."""

    text: str
    offset: int

    def __neg__(self) -> Decimal:
        result = Decimal(-float(self))
        result.text, result.offset = f"-{self.text}", self.offset
        return result


class Whole(int):
    """An integer that knows where it stands."""

    offset: int


POSITIONED = {"IDENT": Name, "VAR": Name, "ENUM_VAL": Name, "DOUBLE": Decimal, "INTEGER": Whole}


class FaultError(Exception):
    """The text is at fault."""

    def __init__(self, message: str, offset: int = -1) -> None:
        super().__init__(message)
        self.offset = offset


class Positioned:
    """The lexer, its tokens told where they stand; refuses what the grammar would pass over."""

    def __init__(self, lexer: Any) -> None:
        self.lexer = lexer
        self.data = ""
        self.seen: set[str] = set()
        self.blocks: set[str] = set()
        self.last = ("", -1)

    def input(self, data: str) -> None:
        self.data = data
        self.lexer.input(data)

    def token(self) -> Any:
        token = self.lexer.token()
        if token is None:
            return None
        kind, offset = token.type, token.lexpos
        if kind in POSITIONED:
            token.value = POSITIONED[kind](token.value)
            token.value.offset = offset
        if kind == "DOUBLE":
            match = DECIMAL.match(self.data, offset)
            token.value.text = match[0] if match else repr(float(token.value))
        self.notice(kind, offset)
        return token

    def notice(self, kind: str, offset: int) -> None:
        """Refuse second blocks and sections."""
        before = self.last[0]
        if kind == "IDENT" and before in ("DOMAIN", "INSTANCE", "NON_FLUENTS", "POLICY"):
            if before == "POLICY":
                raise FaultError("a policy block is not read: remove it", self.last[1])
            if before in self.blocks:
                block = before.lower().replace("_", "-")
                raise FaultError(f"a second {block} block: give one domain and one instance", self.last[1])
            self.blocks.add(before)
        if kind in ONCE:
            section = ONCE[kind]
            if section in self.seen:
                raise FaultError(f"a second {section} section: give it once", offset)
            self.seen.add(section)
        self.last = (kind, offset)


def limit(memory: int, cpu: int) -> None:
    """Bound this process; where a limit is not known, the parent's time limit remains."""
    try:
        import resource
    except ImportError:
        return
    for name, value in (
        ("RLIMIT_AS", memory),
        ("RLIMIT_CPU", cpu),
        ("RLIMIT_CORE", 0),
        ("RLIMIT_FSIZE", 0),
    ):
        kind = getattr(resource, name, None)
        if kind is not None:
            with contextlib.suppress(ValueError, OSError):
                resource.setrlimit(kind, (value, value))


def load(packages: str) -> Any:
    """pyRDDLGym's modules for parsing and checking, without what its top package loads."""
    if packages not in sys.path:
        sys.path.append(packages)
    folder = Path(packages) / "pyRDDLGym"
    for name, place in (("pyRDDLGym", folder), ("pyRDDLGym.core", folder / "core")):
        module = types.ModuleType(name)
        module.__path__ = [str(place)]
        sys.modules[name] = module
    from ply import yacc
    from pyRDDLGym.core.compiler.model import RDDLLiftedModel
    from pyRDDLGym.core.parser import parser as grammar
    from pyRDDLGym.core.parser.nonfluents import NonFluents

    return yacc, grammar, RDDLLiftedModel, NonFluents


def tools(modules: Any) -> tuple[Any, Any]:
    """A parser and a lexer of pyRDDLGym's grammar, with our messages."""
    yacc, grammar, _, non_fluents = modules

    def refuse_character(self: Any, token: Any) -> None:
        raise FaultError(f"the character {token.value[0]!r} has no place in RDDL", token.lexpos)

    def refuse_token(self: Any, token: Any) -> None:
        if token is None:
            raise FaultError("the text ends in the middle of a block: a closing brace is missing")
        shown = self.lexer.data[token.lexpos :].split(maxsplit=1)[0][:40]
        hint = ""
        if token.type in self.reverse_tokens:
            hint = f"; {self.reverse_tokens[token.type]!r} is a word of the language"
        raise FaultError(f"syntax error at {shown!r}{hint}", token.lexpos)

    def complete(blocks: Any) -> Any:
        blocks = blocks or {}
        for block in ("domain", "instance"):
            if block not in blocks:
                raise FaultError(f"the text has no {block} block")
        if "non_fluents" not in blocks:
            objects = getattr(blocks["instance"], "objects", [])
            sections = {"domain": blocks["domain"].name, "objects": objects, "init_non_fluent": []}
            blocks["non_fluents"] = non_fluents("none", sections)
        return original(blocks)

    original, grammar.RDDL = grammar.RDDL, complete
    inner = type("Lexer", (grammar.RDDLlex,), {"t_error": refuse_character})()
    inner.build(errorlog=yacc.NullLogger())
    parser = type("Parser", (grammar.RDDLParser,), {"p_error": refuse_token})()
    parser.build(debug=False, write_tables=False, errorlog=yacc.NullLogger())
    return parser, inner


def parse(text: str, parser: Any, lexer: Any) -> Any:
    """pyRDDLGym's syntax tree of `text`, its tokens with their places."""
    parser.lexer = Positioned(lexer)
    try:
        return parser.parse(text)
    except KeyError as error:
        raise FaultError(f"the domain block has no {error.args[0]} section") from None
    except ValueError:  # Python converts numbers of some thousand digits at most
        long = re.search(r"[0-9]{4000}", text)
        if long is None:
            raise
        raise FaultError("a number of more than 1000 digits", long.start()) from None


class Table:
    """Expressions as rows, parts before the whole."""

    def __init__(self) -> None:
        self.rows: list[list[Any]] = []

    def add(self, root: Any) -> int:
        """The number of the row of `root`; without recursion."""
        found: list[int] = []
        work: list[tuple[Any, list[Any] | None]] = [(root, None)]
        while work:
            thing, row = work.pop()
            if row is None:
                row, parts = self.read(thing)
                work.append((len(parts), row))
                work.extend((part, None) for part in reversed(parts))
                continue
            count = thing
            row[3] = found[len(found) - count :]
            del found[len(found) - count :]
            if row[1] < 0:
                row[1] = next((self.rows[i][1] for i in row[3] if self.rows[i][1] >= 0), -1)
            if len(self.rows) >= MAXIMUM_NODES:
                raise FaultError(f"more than {MAXIMUM_NODES} parts of expressions", row[1])
            found.append(len(self.rows))
            self.rows.append(row)
        return found[0]

    def read(self, thing: Any) -> tuple[list[Any], list[Any]]:
        """A row without its parts, and the parts."""
        if isinstance(thing, str):
            return row_of("name", thing, place(thing)), []
        head, body = thing[0], thing[1]
        if head == "number":
            return row_of("number", number_text(body), place(body)), []
        if head == "boolean":
            return row_of("boolean", "true" if body else "false"), []
        if head == "pvar_expr":
            name, arguments = body
            if arguments is None and str(name)[:1] in "?@":
                return row_of("name", name, place(name)), []
            return row_of("fluent", name, place(name)), list(arguments or ())
        if head in ("randomvar", "func"):
            return self.call(head, body)
        if head == "if":
            return row_of("if", ""), list(body)
        if head == "switch":
            return switch(body)
        if head in AGGREGATES:
            binders = [[str(part) for part in bound[1]] for bound in body[:-1]]
            return row_of("aggregate", head, place(body[0][1][0]), binders), [body[-1]]
        if head in ("-", "+") and len(body) == 1:
            return row_of("operator", "negate" if head == "-" else "plus"), list(body)
        if head in CHAINS or head == "-":
            return row_of("operator", "+" if head == "-" else head), chain(head, body)
        if isinstance(body, tuple) and head in OTHERS:
            return row_of("operator", head), list(body)
        if head in MATRICES or head in ("randomvector", "pyfunc"):
            return row_of("unsupported", "python function" if head == "pyfunc" else str(head)), []
        return row_of("unsupported", f"{head}_{{...}}", place(head)), []

    def call(self, head: str, body: Any) -> tuple[list[Any], list[Any]]:
        name, arguments = body
        if head == "func":
            return row_of("function", name, place(name)), list(arguments)
        if name.endswith("(p)"):
            binders = [[str(part) for part in bound[1]] for bound in arguments[:-1]]
            return row_of("discrete_over", name[:-3], -1, binders), [arguments[-1][0]]
        if name in ("Discrete", "UnnormDiscrete"):
            labels = [str(case[1][0]) for case in arguments[1:]]
            chances = [case[1][1] for case in arguments[1:]]
            if any(isinstance(chance, str) for chance in chances):
                return row_of("unsupported", "otherwise in Discrete"), []
            offset = place(arguments[0][1])
            return row_of("discrete", name, offset, [["", str(arguments[0][1])]], labels), chances
        return row_of("draw", name), list(arguments)


def switch(body: Any) -> tuple[list[Any], list[Any]]:
    """switch (e) {...} as a row and parts."""
    parts, labels = [body[0]], []
    for case in body[1:]:
        if case[0] == "case":
            labels.append("case")
            parts.extend(case[1])
        else:
            labels.append("default")
            parts.append(case[1])
    return row_of("switch", "", -1, None, labels), parts


def chain(operator: str, body: Any) -> list[Any]:
    """a + b - c + d as four parts, -c among them: the grammar nests them to the left."""
    family = ("+", "-") if operator in ("+", "-") else (operator,)
    parts: list[Any] = []
    while True:
        left, right = body
        parts.append(("-", (right,)) if operator == "-" else right)
        if left[0] in family and isinstance(left[1], tuple) and len(left[1]) == 2:
            operator, body = left[0], left[1]
            continue
        parts.append(left)
        return parts[::-1]


def row_of(
    kind: str, text: Any, offset: int = -1, binders: list[list[str]] | None = None, labels: Any = ()
) -> list[Any]:
    return [kind, offset, str(text), [], binders or [], list(labels)]


def place(thing: Any) -> int:
    offset = getattr(thing, "offset", -1)
    return offset if isinstance(offset, int) else -1


def number_text(value: Any) -> str:
    text = getattr(value, "text", None)
    return text if isinstance(text, str) else repr(int(value) if isinstance(value, int) else float(value))


def value_of(value: Any) -> list[Any] | None:
    """A value in a declaration, as [kind, text]."""
    if value is None:
        return None
    if isinstance(value, bool):
        return ["boolean", "true" if value else "false"]
    if isinstance(value, (int, float)):
        return ["number", number_text(value)]
    return ["object", str(value).removeprefix("@")]


def describe(ast: Any) -> dict[str, Any]:
    """All that was declared, as plain data."""
    domain, instance = ast.domain, ast.instance
    table = Table()

    def roots(expressions: Any) -> list[int]:
        return [table.add(expression) for expression in expressions or ()]

    cpfs = []
    for cpf in domain.cpfs[1]:
        name, variables = cpf.pvar[1]
        cpfs.append([str(name), [str(v) for v in variables or ()], table.add(cpf.expr), place(name)])
    objects = {str(name): [str(o) for o in listed] for name, listed in ast.non_fluents.objects or ()}
    kinds = [
        [str(name), values != "object", objects.get(str(name), []) if values == "object" else
         [str(v).removeprefix("@") for v in values]]
        for name, values in domain.types
    ]  # fmt: skip
    horizon = getattr(instance, "horizon", None)
    if horizon is not None and not isinstance(horizon, (int, str)):
        raise FaultError("horizon = terminate-when (...) is not read: use termination { ... }")
    pairs = zip((instance, ast.non_fluents, instance), ("domain", "domain", "non_fluents"), strict=True)
    return {
        "domain": str(domain.name),
        "instance": str(instance.name),
        "requirements": [str(r) for r in domain.requirements or ()],
        "types": kinds,
        "fluents": [
            [str(v.name), v.fluent_type, str(v.range), [str(p) for p in v.param_types or ()],
             value_of(v.default), place(v.name)]
            for v in domain.pvariables
        ],
        "cpfs": cpfs,
        "reward": table.add(domain.reward),
        "terminals": roots(domain.terminals),
        "preconditions": roots(domain.preconds),
        "constraints": roots(domain.constraints),
        "invariants": roots(domain.invariants),
        "non_fluents": list(assignments(getattr(ast.non_fluents, "init_non_fluent", []))),
        "initial": list(assignments(getattr(instance, "init_state", []))),
        "horizon": None if horizon is None else str(horizon),
        "discount": None if getattr(instance, "discount", None) is None else number_text(instance.discount),
        "concurrent": str(getattr(instance, "max_nondef_actions", "pos-inf")),
        "nodes": table.rows,
        "names": [*(str(getattr(block, key, "")) for block, key in pairs), str(ast.non_fluents.name)],
    }  # fmt: skip


def assignments(pairs: Any) -> Iterator[list[Any]]:
    for (name, arguments), value in pairs:
        values = [str(argument).removeprefix("@") for argument in arguments or ()]
        yield [str(name), values, value_of(value), place(name)]


def check(ast: Any, lifted: Any) -> None:
    """pyRDDLGym's own checks of declarations."""
    instance = ast.instance
    kept = dict(instance.__dict__)
    if not isinstance(getattr(instance, "horizon", None), int):
        instance.horizon = 1
    if getattr(instance, "discount", None) is None:
        instance.discount = 1.0
    try:
        lifted(ast)
    except (MemoryError, RecursionError):
        raise
    except Exception as error:
        text = re.sub(r"\x1b\[[0-9;]*m", "", str(error)).strip().partition("\n")[0]
        raise FaultError(text.replace("<", "'").replace(">", "'")[:400] or type(error).__name__) from None
    instance.__dict__.clear()
    instance.__dict__.update(kept)


def answer(text: str, packages: str) -> dict[str, Any]:
    """What the parent shall know."""
    try:
        modules = load(packages)
    except ImportError as error:
        return {"missing": str(error)}
    return described(text, *tools(modules), modules[2])


def described(text: str, parser: Any, lexer: Any, lifted: Any) -> dict[str, Any]:
    """What `text` declares, or what is wrong with it."""
    try:
        ast = parse(text, parser, lexer)
        check(ast, lifted)
        return describe(ast)
    except FaultError as fault:
        return {"error": str(fault), "offset": fault.offset}
    except RecursionError:
        return {"error": "expressions are nested too deeply", "offset": -1}


def main() -> None:
    memory, cpu, output, packages = sys.argv[1:5]
    limit(int(memory), int(cpu))
    stream = os.fdopen(os.dup(1), "wb")
    for printed in (1, 2):  # what libraries print is no part of the answer
        os.dup2(os.open(os.devnull, os.O_WRONLY), printed)
    try:
        data = json.dumps(answer(sys.stdin.buffer.read().decode("utf-8"), packages)).encode("ascii")
    except MemoryError:
        data = b'{"limit": "memory"}'
    with stream:
        stream.write(data if len(data) <= int(output) else b'{"limit": "output"}')


if __name__ == "__main__":
    main()
