"""Reads a PRISM program with stormpy and prints it as JSON: the program of a child process.

    python -I prism_child.py FILE SECONDS MEGABYTES

It imports nothing of this package, so it may be run as it stands, and it limits itself: processor time,
memory, number of nodes. Standard output is one JSON object, either {"error": TEXT} or

    version     of stormpy
    constants   [name, type, node or null]
    variables   [name, module or null, low, high, first]; no bounds for truth values, no first after `init`
    modules     [name, [[label, guard, [[chance, [[variable, value], ...]], ...]], ...]]
    labels      [name, node]
    initial     node or null
    nodes       ["int", "5"], ["rational", "1/10"], ["bool", truth], ["name", name], [operator, node, ...]

A node names nodes that stand before it, by number.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from typing import Any

MAXIMUM_NODES = 1_000_000
MAXIMUM_STEPS = 5_000_000


class Refused(Exception):
    """The program has what is not read; the message says what."""


class Nodes:
    """Expressions as numbered nodes, equal ones once."""

    def __init__(self) -> None:
        self.rows: list[tuple[Any, ...]] = []
        self.numbers: dict[tuple[Any, ...], int] = {}
        self.steps = 0

    def add(self, expression: Any) -> int:
        """The number of an expression; without recursion."""
        done: list[int] = []
        stack: list[tuple[Any, int]] = [(expression, -1)]
        while stack:
            e, arity = stack.pop()
            self.steps += 1
            if self.steps > MAXIMUM_STEPS:
                raise Refused(
                    f"its expressions have more than {MAXIMUM_STEPS:,} parts, formulas written out"
                )
            if arity >= 0:
                parts = tuple(done[len(done) - arity :])
                del done[len(done) - arity :]
                done.append(self.number((operator(e), *parts)))
            elif e.is_literal():
                done.append(self.number(literal(e)))
            elif e.is_variable():
                done.append(self.number(("name", e.get_identifier())))
            else:
                stack.append((e, e.arity))
                stack.extend((e.get_operand(i), -1) for i in reversed(range(e.arity)))
        return done[0]

    def number(self, row: tuple[Any, ...]) -> int:
        """The number of a node."""
        key = (type(row[1]), *row)
        found = self.numbers.get(key)
        if found is None:
            if len(self.rows) >= MAXIMUM_NODES:
                raise Refused(f"its expressions have more than {MAXIMUM_NODES:,} different parts")
            found = self.numbers[key] = len(self.rows)
            self.rows.append(row)
        return found


def literal(e: Any) -> tuple[Any, ...]:
    """A constant as a node."""
    if e.has_boolean_type():
        return ("bool", bool(e.evaluate_as_bool()))
    if e.has_integer_type():
        return ("int", str(int(e.evaluate_as_int())))
    return ("rational", str(e.evaluate_as_rational()))


def operator(e: Any) -> str:
    """The name of an operator."""
    try:
        return str(e.operator.name)
    except ValueError:  # the bindings do not know all operators
        raise Refused(f"an operator that is not read (such as log) in {str(e)[:200]}") from None


def described(program: Any, version: str) -> dict[str, Any]:
    """A program as plain data; see the module's docstring."""
    nodes = Nodes()
    begun = bool(program.has_initial_states_expression)

    def constant(c: Any) -> list[Any]:
        kind = "int" if c.type.is_integer else "bool" if c.type.is_boolean else "double"
        return [c.name, kind, nodes.add(c.definition) if c.defined else None]

    variables: list[list[Any]] = []

    def declare(module: str | None, integers: Any, truths: Any) -> None:
        for v in integers:
            first = None if begun else nodes.add(v.initial_value_expression)
            bounds = [nodes.add(v.lower_bound_expression), nodes.add(v.upper_bound_expression)]
            variables.append([v.name, module, *bounds, first])
        for v in truths:
            first = None if begun else nodes.add(v.initial_value_expression)
            variables.append([v.name, module, None, None, first])

    declare(None, program.global_integer_variables, program.global_boolean_variables)
    modules = []
    for module in program.modules:
        declare(module.name, module.integer_variables, module.boolean_variables)
        commands = []
        for command in module.commands:
            outcomes = [
                [
                    nodes.add(update.probability_expression),
                    [[a.variable.name, nodes.add(a.expression)] for a in update.assignments],
                ]
                for update in command.updates
            ]
            label = command.action_name if command.is_labeled else ""
            commands.append([label, nodes.add(command.guard_expression), outcomes])
        modules.append([module.name, commands])
    return {
        "version": version,
        "constants": [constant(c) for c in program.constants],
        "variables": variables,
        "modules": modules,
        "labels": [[label.name, nodes.add(label.expression)] for label in program.labels],
        "initial": nodes.add(program.initial_states_expression) if begun else None,
        "nodes": nodes.rows,
    }


def main() -> None:
    """Read the file that is named, and print what it holds."""
    path, seconds, megabytes = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    resource.setrlimit(resource.RLIMIT_AS, (megabytes << 20, megabytes << 20))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    output = os.dup(1)
    os.dup2(2, 1)  # what the library prints is no answer
    answer: dict[str, Any]
    try:
        import stormpy

        program = stormpy.parse_prism_program(path, simplify=False).substitute_formulas()
        answer = described(program, str(stormpy.__version__))
    except Refused as refused:
        answer = {"error": str(refused)}
    except MemoryError:
        answer = {"error": f"it needs more than {megabytes} MB to be read"}
    except Exception as error:  # whatever the library raises is told
        answer = {"error": f"{error}"[:4000] or type(error).__name__}
    with os.fdopen(output, "w", encoding="utf-8") as stream:
        json.dump(answer, stream)
        stream.flush()
    os._exit(0)  # the library need not tidy up


if __name__ == "__main__":
    main()
