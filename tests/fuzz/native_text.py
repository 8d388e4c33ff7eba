"""Texts in the native format, from its grammar (`factored_polca.formats.native`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .choices import Choices
from .pieces import BAD_NAMES, discount, name, number

FEATURES = ("x", "y", "z")
ACTIONS = ("go", "stay")

WORDS = tuple(
    text.encode()
    for text in (
        "[", "]", "{", "}", "=", ",", ".", '"', "'", '"""', "'''", "#", "\\", "\\u0000", "\\U00110000",
        "\n",
        "discount", "features", "actions", "tasks", "reward", "initial", "effects.", "senses.",
        "observations",
        "parameters", "terminal", "horizon", "observability", "partial", "full", "pseudo_reward",
        "observes",
        "[features]\n", "[actions.a]\n", "[[tasks]]\n", "[tasks.T]\n", "x = 'boolean'\n", '"0..4"',
        "'0..99999'",
        "1979-05-27", "true", "inf", "switch(x, ", "else: ", " if ", " else ", " and ", " or ", "not ",
        " in ",
        "uniform(", "bernoulli(", "min(", "max(", "abs(", "**", "//", "%", "==", "<=", "!=", "+", "-", "*",
        "/",
        "(2**1000)**19", "2**9999", "9**9**9", "(" * 90, "{" * 90, "[" * 90, "-" * 90, "not " * 90,
        "a." * 40,
        "if x else " * 90, "'0..999999999999999999'", "null", "values", "observed", "`", "x'", "{x: 1}",
    )
)  # fmt: skip


_KINDS = {"x": '"0..2"', "y": '["on", "off"]', "z": '"boolean"', "o": '["on", "off", "none"]'}
_LITERALS = {"x": ("0", "1", "2"), "y": ("on", "off"), "z": ("true", "false"), "o": ("on", "off", "none")}
_SPREAD = {
    "x": ("{0: 0.9, 1: 0.1}", "{x: 1/2, 2: 1/2}", "min(x + 1, 2)", "uniform(0, 1)", "x", "max(x - 1, 0)"),
    "y": ("{on: 1/2, off: 1/2}", "y", "{on: 1/3, off: 2/3}"),
    "z": ("{true: 0.25, false: 0.75}", "bernoulli(0.5)", "not z", "z", "x == 1"),
    "o": ("{on: 1/2, off: 1/2}", "{on: 0.1, none: 0.9}", "on if x' == 0 else none"),
}


def native_text(c: Choices) -> bytes:
    """A file."""
    lines = (
        []
        if c.rarely(40)
        else [f"discount = {discount(c)}" if c.below(4) else f'discount = "{discount(c)}"']
    )
    partial = c.below(2) == 1
    count = 1 + c.below(3)
    known = FEATURES[:count]
    if partial:
        lines.append('observability = "partial"')
    if c.rarely(6):
        lines.append(f"horizon = {number(c)}")
    if c.rarely(4):
        lines.append(f"terminal = {_quoted(c, _condition(c, 2, known))}")
    if c.below(3):
        lines.append(f"reward = {_terms(c, known)}")
    if c.rarely(8):
        lines.append(f"initial_factors = [{_quoted(c, expression(c, 2, known))}]")
    if c.rarely(10):
        lines.append(f"{_key(c, ('name', 'description'))} = {_quoted(c, name(c))}")
    if c.rarely(4):
        lines += ["[parameters]", f"p = {number(c)}"]
    lines.append("[features]")
    lines += [f"{_key(c, (word,))} = {_values(c, word)}" for word in known]
    if partial and c.below(4):
        lines += ["[observations]", f"o = {_values(c, 'o')}"]
    else:
        partial = False
    if c.below(2):
        lines.append("[initial]")
        lines += [f"{word} = {_initial(c, word)}" for word in known[: c.below(count + 1)]]
    for action in ACTIONS[: 1 + c.below(2)]:
        lines.append(f"[actions.{_key(c, (action,))}]")
        for word in known[: c.below(count + 1)]:
            lines.append(f"effects.{_key(c, (word,))} = {_quoted(c, _lottery(c, 3, word, known))}")
        if partial and c.below(4):
            lines.append(f"senses.o = {_quoted(c, _lottery(c, 2, 'o', known))}")
        if c.rarely(3):
            lines.append(f"reward = {_terms(c, known)}")
        if c.rarely(4) and not partial:
            lines.append(f"applicable = {_quoted(c, _condition(c, 2, known))}")
    if c.rarely(3):
        for task, below in (("Root", ("Child",)), ("Child", ())):
            listed = ", ".join(f'"{name(c, (word,))}"' for word in ("go", *below))
            lines += [f"[tasks.{_key(c, (task,))}]", f"actions = [{listed}]"]
            if c.below(2):
                lines.append(f"terminal = {_quoted(c, _condition(c, 2, known))}")
            if c.below(2):
                lines.append(f"pseudo_reward = {_pseudo(c, known)}")
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _key(c: Choices, known: Sequence[str]) -> str:
    word = name(c, known)
    if word in known or c.rarely():
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _quoted(c: Choices, text: str) -> str:
    if c.rarely(60):
        return text
    return " + text + " if '"' in text else '"' + text + '"'


def _values(c: Choices, word: str) -> str:
    if not c.rarely(10):
        return (
            f"{{ values = {_KINDS[word]}, observed = true }}"
            if c.rarely(8) and word != "o"
            else _KINDS[word]
        )
    match c.below(3):
        case 0:
            return c.one(
                ('"0..0"', '"-1..1"', '"2..1"', '"0..99"', '"0..100000"', '"0..9999999999"', '"a..b"', "[]")
            )
        case 1:
            values = ", ".join(_quoted(c, name(c)) for _ in c.some(0, 3))
            return f"{{ values = [{values}], {c.one(('observed = true', 'null = 0', 'x = 1'))} }}"
        case _:
            return "[" + ", ".join(f'"{name(c)}"' for _ in c.some(1, 3)) + "]"


def _initial(c: Choices, word: str) -> str:
    if c.below(2):
        return '"uniform"'
    return _quoted(c, c.one(_LITERALS[word]))


def _terms(c: Choices, known: Sequence[str]) -> str:
    match c.below(3):
        case 0:
            return number(c)
        case 1:
            return _quoted(c, expression(c, 3, known))
        case _:
            return "[" + ", ".join(_quoted(c, expression(c, 2, known)) for _ in c.some(0, 3)) + "]"


def _pseudo(c: Choices, known: Sequence[str]) -> str:
    if c.below(2):
        return _terms(c, known)
    return f"{{ {_key(c, ACTIONS[:1])} = {_quoted(c, expression(c, 2, known))} }}"


def _lottery(c: Choices, depth: int, target: str, known: Sequence[str]) -> str:
    def deeper() -> str:
        return _lottery(c, depth - 1, target, known)

    if depth and c.below(3) == 2:
        return f"{deeper()} if {_condition(c, depth - 1, known)} else {deeper()}"
    if depth and c.rarely(6):
        return _switch(c, deeper, known)
    if c.rarely(20):
        return f"{{{expression(c, 1, known)}: {number(c)}, {expression(c, 1, known)}: {number(c)}}}"
    return c.one(_SPREAD[target]) if c.below(2) else name(c, _LITERALS[target])


def _switch(c: Choices, case: Callable[[], str], known: Sequence[str]) -> str:
    word = c.one(known)
    cases = ", ".join(f"{name(c, (value,))}: {case()}" for value in _LITERALS[word][: c.below(3)])
    return f"switch({name(c, (word,))}, {cases + ', ' if cases else ''}else: {case()})"


def _condition(c: Choices, depth: int, known: Sequence[str]) -> str:
    if depth and c.below(3) == 2:
        joined = c.one((" and ", " or "))
        negated = "not " if c.rarely(4) else ""
        return f"{_condition(c, depth - 1, known)}{joined}{negated}{_condition(c, depth - 1, known)}"
    word = c.one(known)
    match c.below(3):
        case 0:
            return f"{name(c, (word,))} == {name(c, _LITERALS[word])}"
        case 1:
            return f"{name(c, (word,))} {c.one(('<', '<=', '!=', '>', '>='))} {number(c)}"
        case _:
            return f"{name(c, (word,))} in {{{', '.join(_LITERALS[word][: 1 + c.below(2)])}}}"


def expression(c: Choices, depth: int, known: Sequence[str]) -> str:
    """An expression of the language."""

    def deeper() -> str:
        return expression(c, depth - 1, known)

    if not depth or c.ended:
        if c.below(2):
            return number(c)
        return (
            name(c, (*known, *(f"{word}'" for word in known))) if not c.rarely(8) else name(c, ("o", "p"))
        )
    match c.below(8):
        case 0 | 1:
            return f"{deeper()} if {_condition(c, depth - 1, known)} else {deeper()}"
        case 2:
            return f"{deeper()} {c.one(('+', '-', '*', '+', '/', '//', '%', '**'))} {deeper()}"
        case 3:
            return f"({deeper()})" if c.below(2) else f"-{deeper()}"
        case 4:
            word = (
                c.one(("min", "max"))
                if not c.rarely(8)
                else c.one(("abs", "bernoulli", "uniform", "eval", "switch"))
            )
            return f"{word}({deeper()}, {deeper()})"
        case 5:
            return _switch(c, deeper, known)
        case 6 if c.rarely(4):
            return c.one(("`x`", '"on"', "`" + c.one(BAD_NAMES) + "`", '"' + c.one(BAD_NAMES) + '"'))
        case _:
            return number(c)
