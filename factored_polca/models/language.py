"""The text form of expressions: a small language read by precedence climbing, and its printer.

    expression  ::= choice ["if" choice "else" expression]
    choice      ::= conjunct {"or" conjunct}            conjunct ::= inverse {"and" inverse}
    inverse     ::= "not" inverse | sum {("=="|"!="|"<"|"<="|">"|">=") sum} | sum ["not"] "in" set
    sum         ::= term {("+"|"-") term}               term ::= factor {("*"|"/"|"//"|"%") factor}
    factor      ::= "-" factor | atom ["**" factor]
    atom        ::= number | "true" | "false" | name ["'"] | string | "(" expression ")" | call
                  | "{" [expression ":" expression {"," ...}] "}"
    call        ::= ("min"|"max"|"abs"|"bernoulli"|"uniform") "(" expression {"," expression} ")"
                  | "switch" "(" name ["'"] {"," value ":" expression} ["," "else" ":" expression] ")"
    set         ::= "{" value {"," value} "}"

A quote after a name means the next state, so strings are written in double quotes (needed for a
value whose name is not an identifier or is also a feature's); a name that is not an identifier is
written in back quotes.  `bernoulli(p)` is {true: p, false: 1 - p}; `uniform(u, v, w)` gives each 1/3;
comparisons may be chained.

The text comes from strangers, so nothing here hands it to Python.  The design suggested Python's
`ast` for this; a parser of our own was chosen because it reads primes, knows the column of
everything, and bounds depth and length by counting instead of by the interpreter's stack.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import (
    FALSE,
    ONE,
    TRUE,
    Conditional,
    Constant,
    Expression,
    Lottery,
    Reference,
    Switch,
    conjunction,
    depth,
    disjunction,
    grouped,
    operation,
)
from factored_polca.models.scalars import MAXIMUM_BITS, OPERATORS, Value
from factored_polca.models.scope import Scope
from factored_polca.models.work import MAXIMUM_STEPS, Work, steps_of

MAXIMUM_LENGTH: Final = 1_000_000
"""Characters in one expression."""
MAXIMUM_DEPTH: Final = 80
"""Levels of nesting."""
MAXIMUM_DIGITS: Final = 4_000
"""Digits in one number."""
MAXIMUM_DECIMAL_EXPONENT: Final = 400

_TOKEN: Final = re.compile(
    r"""(?P<space>[ \t\r\n]+)
      | (?P<number>(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)
      | (?P<name>[^\W\d]\w*)
      | (?P<quoted>`[^`\n]*`)
      | (?P<string>"[^"\n]*")
      | (?P<symbol>\*\*|//|==|!=|<=|>=|[-+*/%<>(){},:'])""",
    re.VERBOSE,
)
KEYWORDS: Final = frozenset(
    [
        "and",
        "or",
        "not",
        "if",
        "else",
        "in",
        "true",
        "false",
        "min",
        "max",
        "abs",
        "bernoulli",
        "uniform",
        "switch",
    ]
)
_COMPARISONS: Final = {
    row.symbol: row.name for row in OPERATORS.values() if row.kind in ("order", "equality")
}
_SUMS: Final = {"+": "add", "-": "subtract"}
_TERMS: Final = {"*": "multiply", "/": "divide", "//": "floor_divide", "%": "modulo"}


@dataclass(frozen=True, slots=True)
class _Token:
    kind: str
    text: str
    start: int


def number(text: str) -> Fraction:
    """The exact rational that a decimal number such as `0.1`, `3` or `2.5e-3` denotes.

    Raises:
        ValueError: not a number, or more digits or a larger exponent than the caps allow.
    """
    mantissa, _, exponent = text.lower().partition("e")
    if len(mantissa) > MAXIMUM_DIGITS:
        raise ValueError(f"a number of more than {MAXIMUM_DIGITS} digits")
    if exponent and (len(exponent) > 6 or abs(int(exponent)) > MAXIMUM_DECIMAL_EXPONENT):
        raise ValueError(f"a decimal exponent beyond {MAXIMUM_DECIMAL_EXPONENT}")
    value = Fraction(text)
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > MAXIMUM_BITS:
        raise ValueError(f"a number of more than {MAXIMUM_BITS} bits")
    return value


class _Parser:
    def __init__(self, text: str, scope: Scope | None, work: Work) -> None:
        self.text = text
        self.scope = scope
        self.work = work
        self.depth = 0
        if len(text) > MAXIMUM_LENGTH:
            raise self.error(f"an expression of more than {MAXIMUM_LENGTH} characters", 0)
        self.position = 0
        self.tokens: list[_Token] = []
        self.tokens = self._tokens()
        self.spend(len(self.tokens), 0)

    def spend(self, steps: int, start: int) -> None:
        """Count work; the limit is on all expressions of a file."""
        if not self.work.count(steps):
            raise self.error(f"the expressions need more than {MAXIMUM_STEPS} steps", start)

    def folded(self, result: Expression) -> Expression:
        """`result`, its arithmetic counted."""
        if isinstance(result, Constant) and isinstance(result.value, Fraction):
            self.spend(steps_of(result.value), self.token.start)
        return result

    def error(self, message: str, start: int, hint: str = "") -> ModelError:
        line = self.text.count("\n", 0, start) + 1
        column = start - (self.text.rfind("\n", 0, start) + 1) + 1
        return ModelError([Fault(message, hint=hint, line=line, column=column)])

    def _tokens(self) -> list[_Token]:
        tokens: list[_Token] = []
        start = 0
        while start < len(self.text):
            match = _TOKEN.match(self.text, start)
            if match is None:
                character = self.text[start]
                hint = "comparison is written ==" if character == "=" else ""
                raise self.error(f"unexpected character {character!r}", start, hint)
            kind = match.lastgroup or ""
            if kind != "space":
                tokens.append(_Token(kind, match.group(), start))
            start = match.end()
        tokens.append(_Token("end", "", len(self.text)))
        return tokens

    @property
    def token(self) -> _Token:
        return self.tokens[self.position]

    def at(self, *texts: str) -> bool:
        token = self.token
        return token.kind in ("symbol", "name") and token.text in texts

    def accept(self, text: str) -> bool:
        if self.at(text):
            self.position += 1
            return True
        return False

    def expect(self, text: str, after: str) -> None:
        if not self.accept(text):
            found = repr(self.token.text) if self.token.text else "the end"
            raise self.error(f"expected {text!r} {after}, found {found}", self.token.start)

    def down(self) -> None:
        self.depth += 1
        if self.depth > MAXIMUM_DEPTH:
            raise self.error(
                f"an expression nested deeper than {MAXIMUM_DEPTH} levels",
                self.token.start,
                "use switch(feature, value: ..., else: ...) for long chains of if",
            )

    # -- grammar ---------------------------------------------------------------------------

    def whole(self) -> Expression:
        result = self.expression()
        if self.token.kind != "end":
            raise self.error(f"unexpected {self.token.text!r} after the expression", self.token.start)
        return result

    def expression(self) -> Expression:
        self.down()
        result = self.choice()
        if self.accept("if"):
            condition = self.choice()
            self.expect("else", "after 'if' and its condition")
            result = Conditional(condition, result, self.expression())
        self.depth -= 1
        return result

    def choice(self) -> Expression:
        parts = [self.conjunct()]
        while self.accept("or"):
            parts.append(self.conjunct())
        return grouped("or", parts) if len(parts) > 1 else parts[0]

    def conjunct(self) -> Expression:
        parts = [self.inverse()]
        while self.accept("and"):
            parts.append(self.inverse())
        return grouped("and", parts) if len(parts) > 1 else parts[0]

    def inverse(self) -> Expression:
        if self.accept("not"):
            self.down()
            result = operation("not", self.inverse())
            self.depth -= 1
            return result
        left = self.sum()
        if self.at("in", "not"):
            negated = self.accept("not")
            self.expect("in", "after 'not'")
            return self.membership(left, negated)
        parts: list[Expression] = []
        while self.token.kind == "symbol" and self.token.text in _COMPARISONS:
            name = _COMPARISONS[self.token.text]
            self.position += 1
            right = self.sum()
            parts.append(operation(name, left, right))
            left = right
        if not parts:
            return left
        return parts[0] if len(parts) == 1 else conjunction(parts)

    def membership(self, left: Expression, negated: bool) -> Expression:
        self.expect("{", "after 'in'")
        tests = [operation("equal", left, self.sum())]
        while self.accept(","):
            tests.append(operation("equal", left, self.sum()))
        self.expect("}", "at the end of the set")
        test = disjunction(tests) if len(tests) > 1 else tests[0]
        return operation("not", test) if negated else test

    def sum(self) -> Expression:
        parts = [self.term()]
        while self.token.kind == "symbol" and self.token.text in _SUMS:
            minus = self.token.text == "-"
            self.position += 1
            right = self.term()
            parts.append(operation("negate", right) if minus else right)
            parts = self.started("add", parts)
        return grouped("add", parts) if len(parts) > 1 else parts[0]

    def term(self) -> Expression:
        run = [self.factor()]
        while self.token.kind == "symbol" and self.token.text in _TERMS:
            name = _TERMS[self.token.text]
            self.position += 1
            if name == "multiply":
                run.append(self.factor())
                run = self.started("multiply", run)
                continue
            left = grouped("multiply", run) if len(run) > 1 else run[0]
            run = [self.folded(operation(name, left, self.factor()))]
        return grouped("multiply", run) if len(run) > 1 else run[0]

    def started(self, name: str, parts: list[Expression]) -> list[Expression]:
        """Two constants that begin a sum or a product as one, where they have a value together."""
        if len(parts) == 2 and all(isinstance(part, Constant) for part in parts):
            start = self.folded(grouped(name, parts))
            if isinstance(start, Constant):
                return [start]
        return parts

    def factor(self) -> Expression:
        if self.accept("-"):
            self.down()
            result = operation("negate", self.factor())
            self.depth -= 1
            return result
        base = self.atom()
        if self.accept("**"):
            self.down()
            base = self.folded(operation("power", base, self.factor()))
            self.depth -= 1
        return base

    def atom(self) -> Expression:
        token = self.token
        if token.kind == "end":
            raise self.error("the expression ends too early", token.start)
        self.position += 1
        if token.kind == "number":
            try:
                return Constant(number(token.text))
            except ValueError as error:
                raise self.error(str(error), token.start) from None
        if token.kind == "string":
            return Constant(token.text[1:-1])
        if token.kind == "quoted":
            return self.reference(token, token.text[1:-1])
        if token.text == "(":
            result = self.expression()
            self.expect(")", "to close '('")
            return result
        if token.text == "{":
            return self.lottery(token)
        if token.kind == "name":
            return self.word(token)
        raise self.error(f"unexpected {token.text!r}", token.start)

    def word(self, token: _Token) -> Expression:
        word = token.text
        if word not in KEYWORDS:
            return self.reference(token, word)
        if word in ("true", "false"):
            return TRUE if word == "true" else FALSE
        if word == "switch":
            return self.switch()
        if word in ("min", "max", "abs", "bernoulli", "uniform"):
            arguments = self.arguments(word)
            if word in ("abs", "bernoulli") and len(arguments) != 1:
                raise self.error(f"{word} takes one argument", token.start)
            if word == "abs":
                return operation("absolute", *arguments)
            if word == "bernoulli":
                (chance,) = arguments
                complement = operation("add", ONE, operation("negate", chance))
                return Lottery(((TRUE, chance), (FALSE, complement)))
            if word == "uniform":
                share = Constant(Fraction(1, len(arguments)))
                return Lottery(tuple((argument, share) for argument in arguments))
            return operation({"min": "minimum", "max": "maximum"}[word], *arguments)
        raise self.error(f"unexpected {word!r}", token.start)

    def reference(self, token: _Token, name: str) -> Expression:
        primed = self.accept("'")
        reference = Reference(name, primed)
        if self.scope is None:
            return reference
        meaning = self.scope.resolve(reference)
        if isinstance(meaning, str):
            raise self.error(meaning, token.start)
        return meaning

    def arguments(self, word: str) -> list[Expression]:
        self.expect("(", f"after {word}")
        arguments = [self.expression()]
        while self.accept(","):
            arguments.append(self.expression())
        self.expect(")", f"to close {word}(")
        return arguments

    def lottery(self, opening: _Token) -> Expression:
        if self.accept("}"):
            raise self.error("an empty distribution", opening.start)
        outcomes = [self.outcome()]
        while self.accept(","):
            outcomes.append(self.outcome())
        self.expect("}", "at the end of the distribution")
        return Lottery(tuple(outcomes))

    def outcome(self) -> tuple[Expression, Expression]:
        value = self.expression()
        self.expect(":", "between a value and its probability")
        return value, self.expression()

    def switch(self) -> Expression:
        self.expect("(", "after switch")
        start = self.token.start
        reference = self.atom()
        if not isinstance(reference, Reference):
            raise self.error("switch needs the name of a feature first", start)
        cases: list[tuple[Value, Expression]] = []
        known: set[tuple[type, Value]] = set()
        otherwise: Expression | None = None
        while self.accept(","):
            start = self.token.start
            if otherwise is not None:
                raise self.error("'else' must be the last case", start)
            if self.accept("else"):
                self.expect(":", "after else")
                otherwise = self.expression()
                continue
            value = self.case_value()
            if (type(value), value) in known:
                raise self.error(f"the value {value!r} has two cases", start)
            known.add((type(value), value))
            self.expect(":", "between a value and its case")
            cases.append((value, self.expression()))
        self.expect(")", "to close switch(")
        return Switch(reference, tuple(cases), otherwise)

    def case_value(self) -> Value:
        token = self.token
        minus = self.accept("-")
        word = self.token
        self.position += 1
        if word.kind == "number" and word.text.isdigit() and len(word.text) <= 18:
            return -int(word.text) if minus else int(word.text)
        if not minus and word.kind in ("string", "quoted"):
            return word.text[1:-1]
        if not minus and word.kind == "name":
            if word.text in ("true", "false"):
                return word.text == "true"
            return word.text
        raise self.error("a case needs a value: an integer, true, false or a name", token.start)


def parse(text: str, scope: Scope | None = None, work: Work | None = None) -> Expression:
    """Read an expression.  With a `scope` names are resolved at once, else by the model.

    `work` counts what all expressions of a file take.

    Raises:
        ModelError: with line and column inside `text`, counted from 1.
    """
    parser = _Parser(text, scope, work or Work())
    result = parser.whole()
    # a token adds at most three levels
    if len(parser.tokens) > MAXIMUM_DEPTH and depth(result) > 3 * MAXIMUM_DEPTH:
        raise parser.error(f"an expression nested deeper than {3 * MAXIMUM_DEPTH} levels", 0)
    return result
