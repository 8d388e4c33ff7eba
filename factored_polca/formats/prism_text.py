"""What stands where in a PRISM program: a scan of its tokens.

The parser (`factored_polca.formats.prism_child`) gives no places, and of the reward structures it gives
only the names. The scan finds the places of constants, variables, labels and commands, by the order in
which they stand, and takes the reward structures apart: `rewards "name" ITEM; ... endrewards` where an
item is `guard : value` or `[action] guard : value`.

`for_the_parser` is the text without its reward structures, blanks in their stead, and with one more
constant c, without a value, and one more module, in which the k-th item stands as the two commands `[]
guard -> true; [] value = c -> true;`. So the parser reads their expressions, too, and what it says of a
line of that module it says of an item.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

from factored_polca.models.errors import Fault, ModelError

Place = tuple[int, int]
"""Line and column, from 1."""

MAXIMUM_TOKENS: Final = 2_000_000

KINDS: Final = {
    "mdp": "mdp", "nondeterministic": "mdp", "dtmc": "dtmc", "probabilistic": "dtmc",
}  # fmt: skip
"""Model types that are read."""

_RATES: Final = "rates are no probabilities; mdp and dtmc are read"
_PARTIAL: Final = "a model that is partially observed is a .pomdpx or .toml file"
_GAME: Final = "there is one decision maker here; mdp and dtmc are read"
_INTERVAL: Final = "a probability is one number here"
REFUSED: Final = {
    "ctmc": ("continuous-time Markov chains", _RATES),
    "stochastic": ("continuous-time Markov chains", _RATES),
    "ma": ("Markov automata", _RATES),
    "ctmdp": ("continuous-time models", _RATES),
    "pta": ("timed automata", "clocks have real values; mdp and dtmc are read"),
    "popta": ("timed automata", "clocks have real values; mdp and dtmc are read"),
    "pomdp": ("partially observed models", _PARTIAL),
    "smg": ("games", _GAME),
    "csg": ("games", _GAME),
    "tsg": ("games", _GAME),
    "imdp": ("interval models", _INTERVAL),
    "idtmc": ("interval models", _INTERVAL),
}
"""Model types that are not: what they are, and why."""

_SECTIONS: Final = {
    "system": ("a system block", "write the modules so that they run in parallel, which is the default"),
    "observables": ("a list of observables", _PARTIAL),
    "observable": ("an observable", _PARTIAL),
    "player": ("a player", _GAME),
    "invariant": ("an invariant", "clocks have real values, features have not"),
}
_WORDS: Final = frozenset({
    *KINDS, *REFUSED, *_SECTIONS, "module", "endmodule", "rewards", "endrewards", "const", "formula",
    "label", "global", "init", "endinit", "endsystem", "endinvariant", "endobservables", "endplayer",
})  # fmt: skip
_TOKEN: Final = re.compile(
    r"""(?P<space>[ \t\r\n\f\v]+|//[^\n]*|/\*.*?\*/)
      | (?P<number>[0-9]+(?:\.[0-9]+)?(?:[eE][+-]?[0-9]+)?|\.[0-9]+)
      | (?P<name>[A-Za-z_][A-Za-z0-9_]*)
      | (?P<string>"[^"\n]*")
      | (?P<symbol>->|\.\.|<=>|<=|>=|!=|=>|=\?|.)""",
    re.VERBOSE | re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Token:
    """A token and where it begins."""

    kind: str
    text: str
    start: int


@dataclass(frozen=True)
class RewardText:
    """An item of a reward structure: the action (None: any state, "": commands without a label)."""

    label: str | None
    guard: str
    value: str
    place: Place


@dataclass(frozen=True)
class StructureText:
    """A reward structure; its name is empty if it has none."""

    name: str
    items: tuple[RewardText, ...]
    place: Place


@dataclass
class Scan:
    """What `scan` finds."""

    text: str
    kind: str = ""
    constants: dict[str, Place] = field(default_factory=dict)
    variables: dict[str, Place] = field(default_factory=dict)
    labels: dict[str, Place] = field(default_factory=dict)
    commands: dict[str, list[Place]] = field(default_factory=dict)  # by module
    renamed: dict[str, Place] = field(default_factory=dict)  # modules that are copies of others
    initial: Place = (0, 0)
    structures: list[StructureText] = field(default_factory=list)
    _holes: list[tuple[int, int]] = field(default_factory=list)
    _newlines: list[int] = field(default_factory=list)

    def place(self, offset: int) -> Place:
        """Line and column of an offset."""
        line = bisect_left(self._newlines, offset)
        start = self._newlines[line - 1] + 1 if line else 0
        return line + 1, offset - start + 1

    @cached_property
    def module(self) -> str:
        """A name for the module of rewards that the text does not have; `constant` is another."""
        return self._free("rewards_")

    @cached_property
    def constant(self) -> str:
        """A name for the constant in that module."""
        return self._free("reward_is_")

    def _free(self, name: str) -> str:
        while name in self.text:
            name += "_"
        return name

    def for_the_parser(self) -> str:
        """The text with its reward structures as commands of a module; see the module's docstring."""
        parts, at = [], 0
        for start, end in self._holes:
            parts += [self.text[at:start], re.sub(r"[^\n]", " ", self.text[start:end])]
            at = end
        parts.append(self.text[at:])
        items = [item for structure in self.structures for item in structure.items]
        if items:
            parts.append(f"\nconst double {self.constant}; module {self.module}\n")
            parts += [f"[] {i.guard} -> true; [] ({i.value}) = {self.constant} -> true;\n" for i in items]
            parts.append("endmodule\n")
        return "".join(parts)

    def original(self, line: int, column: int) -> Place:
        """The place in the text that a place in `for_the_parser` stands for."""
        last = len(self._newlines) + 1
        if line <= last:
            return line, column
        items = [item for structure in self.structures for item in structure.items]
        index = line - last - 2
        return items[index].place if 0 <= index < len(items) else (last, 1)


def _error(scan: Scan, message: str, offset: int, hint: str = "") -> ModelError:
    line, column = scan.place(offset)
    return ModelError([Fault(message, hint=hint, line=line, column=column)])


def scan(text: str) -> Scan:
    """The places and reward structures of a PRISM program.

    Raises:
        ModelError: a kind of model or a section that is not read, or reward structures at fault.
    """
    result = Scan(text)
    result._newlines = [match.start() for match in re.finditer("\n", text)]
    tokens = [token for token in _tokens(result) if token.kind != "space"]
    _Walk(result, tokens).document()
    return result


def _tokens(result: Scan) -> Iterator[Token]:
    for count, match in enumerate(_TOKEN.finditer(result.text)):
        if count > MAXIMUM_TOKENS:
            raise _error(result, f"more than {MAXIMUM_TOKENS:,} tokens", match.start())
        yield Token(match.lastgroup or "", match.group(), match.start())


class _Walk:
    def __init__(self, result: Scan, tokens: Sequence[Token]) -> None:
        self.scan, self.tokens, self.at = result, tokens, 0
        self.end = Token("end", "", len(result.text))

    def peek(self, ahead: int = 0) -> Token:
        place = self.at + ahead
        return self.tokens[place] if 0 <= place < len(self.tokens) else self.end

    def document(self) -> None:
        while self.at < len(self.tokens):
            token = self.peek()
            self.at += 1
            if token.kind != "name":
                continue
            word = token.text
            if word in REFUSED and not self.scan.kind:
                what, hint = REFUSED[word]
                raise _error(self.scan, f"{word}: {what} are not read", token.start, hint)
            if word in KINDS and not self.scan.kind:
                self.scan.kind = KINDS[word]
            elif word in _SECTIONS:
                what, hint = _SECTIONS[word]
                raise _error(self.scan, f"{what} in a program is not read", token.start, hint)
            elif word == "module":
                self.module(token)
            elif word == "rewards":
                self.rewards(token)
            elif word == "const":
                ahead = 1 if self.peek().text in ("int", "double", "bool", "rate", "prob") else 0
                self.put(self.scan.constants, self.peek(ahead))
            elif word == "global":
                self.variable()
            elif word == "label" and self.peek().kind == "string":
                self.put(self.scan.labels, self.peek(), self.peek().text[1:-1])
            elif word == "init":
                self.scan.initial = self.scan.place(token.start)

    def put(self, table: dict[str, Place], token: Token, name: str | None = None) -> None:
        table.setdefault(token.text if name is None else name, self.scan.place(token.start))

    def variable(self) -> None:
        """At the name of a variable; its type must have finitely many values."""
        name, kind = self.peek(), self.peek(2)
        self.put(self.scan.variables, name)
        if kind.kind == "name" and kind.text != "bool":
            hint = f"give it bounds: {name.text[:60]} : [0..10]"
            message = (
                f"{name.text[:60]} is of the type {kind.text[:60]}: features have finitely many values"
            )
            raise _error(self.scan, message, kind.start, hint)

    def module(self, keyword: Token) -> None:
        name = self.peek().text
        if self.peek(1).text == "=":
            self.scan.renamed[name] = self.scan.place(keyword.start)
        self.at += 1
        commands = self.scan.commands.setdefault(name, [])
        fresh = True  # at the start of a declaration or command
        while self.at < len(self.tokens) and self.peek().text != "endmodule":
            token = self.peek()
            if token.text in _SECTIONS:
                return
            if fresh and token.text == "[" and name not in self.scan.renamed:
                commands.append(self.scan.place(token.start))
            elif token.text == "[" and self.peek(-1).text in ("->", "+"):
                raise _error(self.scan, "an interval of probabilities is not read", token.start, _INTERVAL)
            if fresh and token.kind == "name" and self.peek(1).text == ":":
                self.variable()
            fresh = token.text == ";"
            self.at += 1

    def rewards(self, keyword: Token) -> None:
        name = ""
        if self.peek().kind == "string":
            name = self.peek().text[1:-1]
            self.at += 1
        items: list[RewardText] = []
        while self.peek().text != "endrewards":
            items.append(self.item())
        self.at += 1
        end = self.peek(-1).start + len("endrewards")
        self.scan._holes.append((keyword.start, end))
        place = self.scan.place(keyword.start)
        self.scan.structures.append(StructureText(name, tuple(items), place))

    def item(self) -> RewardText:
        first = self.peek()
        label: str | None = None
        if first.text == "[":
            label = "" if self.peek(1).text == "]" else self.peek(1).text
            self.at += 2 if label == "" else 3
            if self.peek(-1).text != "]":
                raise _error(self.scan, "expected ']' after the action of a reward", self.peek(-1).start)
        guard, closing = self.until(":")
        value, closing = self.until(";")
        if not guard or not value:
            wanted = "a reward is written  guard : value;  or  [action] guard : value;"
            raise _error(self.scan, "a reward without guard or value", closing.start, wanted)
        return RewardText(label, guard, value, self.scan.place(first.start))

    def until(self, stop: str) -> tuple[str, Token]:
        """The tokens up to `stop`, the colons of `c ? a : b` passed over; and `stop`."""
        found: list[str] = []
        open_choices = 0
        while True:
            token = self.peek()
            self.at += 1
            if token.kind == "end" or token.text in _WORDS or (token.text == ";" and stop != ";"):
                found_text = repr(token.text[:40]) if token.text else "the end"
                raise _error(self.scan, f"expected {stop!r} in a reward, found {found_text}", token.start)
            if token.text == "->":
                hint = "give the expected value as the reward of a state or an action"
                raise _error(self.scan, "rewards of next states are not read", token.start, hint)
            if token.text == "?":
                open_choices += 1
            elif token.text == ":" and open_choices:
                open_choices -= 1
            elif token.text == stop:
                return " ".join(found), token
            found.append(token.text)
