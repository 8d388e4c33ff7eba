"""XML as a tree of elements that remember their line and column, read without trusting the text.

`parse` builds the tree with expat by way of `defusedxml`: a document type, entities of its own and
references to other files are refused before anything is expanded, and size, depth and number of
elements are counted against limits.  The text is already decoded, so the encoding that its first
line declares is ignored.

`Faults` gathers what is wrong, so that one reading reports more than the first fault.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from typing import Final, NamedTuple
from xml.sax import SAXParseException
from xml.sax.handler import ContentHandler
from xml.sax.xmlreader import AttributesImpl, InputSource, Locator

from defusedxml.common import DefusedXmlException
from defusedxml.expatreader import DefusedExpatParser

from factored_polca.models.errors import Fault, ModelError

MAXIMUM_LENGTH: Final = 20_000_000
"""Characters in one file."""
MAXIMUM_DEPTH: Final = 500
"""Elements inside each other."""
MAXIMUM_ELEMENTS: Final = 1_000_000
"""Elements in one file, and pieces of text: a line, or what stands between lines and references."""
MAXIMUM_FAULTS: Final = 20
"""Faults reported for one file."""
SHOWN: Final = 60
"""Characters of the file that a message repeats."""

_WORD: Final = re.compile(r"\S+")


class Place(NamedTuple):
    """Where something stands in the file, counted from 1."""

    line: int
    column: int


class Element(NamedTuple):
    """An element: its name, attributes, the elements inside it, and its text if it is not blank."""

    name: str
    place: Place
    attributes: dict[str, str]
    children: tuple[Element, ...]
    text: str
    marks: tuple[tuple[int, Place], ...]  # index of a character of the text -> where it stands

    def words(self) -> list[str]:
        """The words of the text."""
        return self.text.split()

    def place_of_word(self, number: int) -> Place:
        """Where word `number` of the text, from 0, stands."""
        for index, match in enumerate(_WORD.finditer(self.text)):
            if index == number:
                start, place = self.marks[bisect_right(self.marks, match.start(), key=lambda m: m[0]) - 1]
                return Place(place.line, place.column + match.start() - start)
        return self.place


@dataclass
class Faults:
    """What has been found wrong so far."""

    found: list[Fault] = field(default_factory=list)

    def add(self, message: str, place: Place, hint: str = "") -> None:
        """Note a fault.

        Raises:
            ModelError: there are `MAXIMUM_FAULTS` of them: reading on is of no use.
        """
        self.found.append(fault(message, place, hint))
        if len(self.found) >= MAXIMUM_FAULTS:
            raise ModelError(self.found)

    @contextmanager
    def gathering(self) -> Iterator[None]:
        """Note the faults of a `ModelError` that the block raises, then go on after the block."""
        try:
            yield
        except ModelError as error:
            known = {id(fault) for fault in self.found}
            self.found += [fault for fault in error.faults if id(fault) not in known]
            if len(self.found) >= MAXIMUM_FAULTS:
                raise ModelError(self.found[:MAXIMUM_FAULTS]) from None

    def raise_if_any(self) -> None:
        """Stop if anything was wrong.

        Raises:
            ModelError: with all the faults.
        """
        if self.found:
            raise ModelError(self.found)


def fault(message: str, place: Place, hint: str = "", severity: str = "error") -> Fault:
    """A fault at `place`."""
    return Fault(message, hint=hint, line=place.line, column=place.column, severity=severity)


def error(message: str, place: Place, hint: str = "") -> ModelError:
    """The error for one fault at `place`."""
    return ModelError([fault(message, place, hint)])


def quoted(text: str) -> str:
    """A piece of the file as a message repeats it."""
    return repr(text if len(text) <= SHOWN else f"{text[:SHOWN]}...")


@dataclass(slots=True)
class _Open:
    """An element whose end has not been read."""

    name: str
    place: Place
    attributes: dict[str, str]
    children: list[Element] = field(default_factory=list)
    pieces: list[str] = field(default_factory=list)
    marks: list[tuple[int, Place]] = field(default_factory=list)
    length: int = 0

    def close(self) -> Element:
        text = "".join(self.pieces)
        blank = not text or text.isspace()
        marks = () if blank else tuple(self.marks)
        return Element(
            self.name, self.place, self.attributes, tuple(self.children), "" if blank else text, marks
        )


class _Builder(ContentHandler):
    """Turns expat's events into elements."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[_Open] = []
        self.root: Element | None = None
        self.count = 0
        self.pieces = 0
        self.locator: Locator = Locator()

    def setDocumentLocator(self, locator: Locator) -> None:
        self.locator = locator

    def place(self) -> Place:
        return Place(self.locator.getLineNumber() or 1, (self.locator.getColumnNumber() or 0) + 1)

    def startElement(self, name: str, attrs: AttributesImpl) -> None:
        place = self.place()
        self.count += 1
        if self.count > MAXIMUM_ELEMENTS:
            raise error(f"more than {MAXIMUM_ELEMENTS} elements", place)
        if len(self.open) >= MAXIMUM_DEPTH:
            raise error(f"elements nested deeper than {MAXIMUM_DEPTH} levels", place)
        self.open.append(_Open(name, place, dict(attrs)))

    def endElement(self, name: str) -> None:
        element = self.open.pop().close()
        if self.open:
            self.open[-1].children.append(element)
        else:
            self.root = element

    def characters(self, content: str) -> None:
        current = self.open[-1]
        if not content.isspace():  # words begin elsewhere
            self.pieces += 1
            if self.pieces > MAXIMUM_ELEMENTS:
                raise error(f"more than {MAXIMUM_ELEMENTS} pieces of text", self.place())
            current.marks.append((current.length, self.place()))
        current.pieces.append(content)
        current.length += len(content)


class _Parser(DefusedExpatParser):
    """Gives each piece of text as soon as it is read, so that its place is known."""

    def reset(self) -> None:
        super().reset()
        self._parser.buffer_text = False  # type: ignore[attr-defined]


def parse(text: str) -> Element:
    """The outermost element of the XML document `text`.

    Raises:
        ModelError: no well-formed XML, a document type, entities or references to other files, or
            more than the limits of this module allow.
    """
    if len(text) > MAXIMUM_LENGTH:
        raise error(f"a file of more than {MAXIMUM_LENGTH} characters", Place(1, 1))
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError as problem:
        line = text.count("\n", 0, problem.start) + 1
        column = problem.start - text.rfind("\n", 0, problem.start)
        raise error("half a surrogate pair is no character", Place(line, column)) from None
    source = InputSource()
    source.setByteStream(BytesIO(data))
    source.setEncoding("utf-8")
    builder = _Builder()
    parser = _Parser(bufsize=len(data) + 1, forbid_dtd=True)  # one piece: none is scanned twice
    parser.setContentHandler(builder)
    try:
        parser.parse(source)
    except DefusedXmlException:
        hint = "POMDPX needs none: remove <!DOCTYPE ...> and write the text out"
        raise error(
            "a document type, entities or references to other files", builder.place(), hint
        ) from None
    except SAXParseException as problem:
        place = Place(problem.getLineNumber() or 1, (problem.getColumnNumber() or 0) + 1)
        hint = "a value such as a<b is written a&lt;b" if "token" in problem.getMessage() else ""
        raise error(f"no well-formed XML: {problem.getMessage()}", place, hint) from None
    assert builder.root is not None, "expat refuses a document without an element"
    return builder.root


def check_attributes(
    element: Element, allowed: Sequence[str] | set[str], needed: Sequence[str] = ()
) -> None:
    """Refuse attributes that `element` does not have, and the lack of one that it needs.

    Raises:
        ModelError: there is such an attribute.
    """
    for name in element.attributes:
        if name not in allowed:
            listed = ", ".join(sorted(allowed)) or "none"
            raise error(f"<{element.name}> has no attribute {quoted(name)}", element.place,
                        f"its attributes are: {listed}")  # fmt: skip
    for name in needed:
        if name not in element.attributes:
            raise error(f"<{element.name}> lacks the attribute {name}", element.place,
                        f'<{element.name} {name}="...">')  # fmt: skip


def no_children(element: Element) -> None:
    """Refuse elements inside `element`.

    Raises:
        ModelError: there is one.
    """
    for child in element.children:
        raise error(f"<{child.name}> inside <{element.name}>, which holds text only", child.place)


def no_text(element: Element) -> None:
    """Refuse text directly inside `element`.

    Raises:
        ModelError: there is some.
    """
    for word in element.words()[:1]:
        raise error(f"the text {quoted(word)} inside <{element.name}>", element.place_of_word(0),
                    "it holds elements only")  # fmt: skip


def only(element: Element, allowed: Sequence[str]) -> Iterator[Element]:
    """The elements inside `element`, which must be of the kinds `allowed`.

    Raises:
        ModelError: text, or an element of another kind.
    """
    no_text(element)
    for child in element.children:
        if child.name not in allowed:
            raise error(f"<{child.name}> inside <{element.name}>", child.place,
                        f"it holds: {', '.join(f'<{name}>' for name in allowed)}")  # fmt: skip
        yield child
