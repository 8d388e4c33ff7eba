"""RDDL (Sanner 2010): domains and instances with Boolean, enumerated and bounded integer fluents.

    domain d { types {...}; pvariables {...}; cpfs {...}; reward = ...; ... }
    non-fluents n { domain = d; objects {...}; non-fluents {...}; }
    instance i { domain = d; non-fluents = n; init-state {...}; horizon = 40; discount = 1.0; }

One text, or two (`DOMAIN.rddl+INSTANCE.rddl`).  pyRDDLGym (Taitler et al. 2022; the extra `rddl`) parses
it, in a child process with limits (`rddl_process`); nothing of its simulator is used.  Here it is grounded
(`rddl_grounding`) and becomes a model (`rddl_model`).  Numbers are exact: 0.1 is 1/10.

A step of RDDL is one of the model: in a state an action is chosen, interm-fluents and the next state are
drawn, observ-fluents report on the next state, the reward of the step follows; where a termination
condition holds, at the start too, the episode has ended.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from factored_polca.formats.rddl_fault import GroundingFault
from factored_polca.formats.rddl_functions import DIGITS
from factored_polca.formats.rddl_grounding import Grounder
from factored_polca.formats.rddl_lifted import Lifted, lifted
from factored_polca.formats.rddl_model import Builder
from factored_polca.formats.rddl_process import Limits, ParseFault, parsed
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.model import Model

Locate = Callable[[Iterable[Fault]], tuple[Fault, ...]]


@dataclass(frozen=True)
class Text:
    """The texts of a model one after the other; `files` names them ("": the caller knows)."""

    files: tuple[str, ...]
    texts: tuple[str, ...]

    @property
    def whole(self) -> str:
        """All texts, each ending its line."""
        return "".join(f"{text}\n" for text in self.texts)

    def place(self, offset: int) -> tuple[str, int, int]:
        """File, line and column of a character; lines and columns count from 1, 0 is unknown."""
        if offset >= 0:
            for file, text in zip(self.files, self.texts, strict=True):
                if offset <= len(text):
                    before = text[:offset]
                    return file, before.count("\n") + 1, offset - (before.rfind("\n") + 1) + 1
                offset -= len(text) + 1
        return "", 0, 0

    def fault(self, message: str, offset: int, hint: str = "", severity: str = "error") -> Fault:
        """A fault at a character."""
        file, line, column = self.place(offset)
        return Fault(message, hint=hint, file=file, line=line, column=column, severity=severity)


def read_rddl_with_warnings(
    texts: Sequence[str], files: Sequence[str] = ("",), limits: Limits | None = None
) -> tuple[Model, tuple[Fault, ...], Locate]:
    """The model of a domain and an instance, what is worth a warning, and a finder of places.

    Raises:
        ModelError: the texts are not right, hold what is not read or ask for too much; no pyRDDLGym.
    """
    text = Text(tuple(files), tuple(map(_lines, texts)))
    try:
        declared, builder, model = built(parsed(text.whole, limits))
    except RecursionError:
        raise ModelError(
            "expressions, or interm-fluents that hang on each other, are nested too deeply"
        ) from None
    except ParseFault as fault:
        alone = "domain block" in str(fault) or "instance block" in str(fault)
        hint = "name both files: DOMAIN.rddl+INSTANCE.rddl" if alone and len(texts) == 1 else ""
        raise ModelError([text.fault(str(fault), fault.offset, hint)]) from None
    except GroundingFault as fault:
        raise ModelError([text.fault(str(fault), fault.offset, fault.hint)]) from None
    warnings = [Fault(note, severity="warning") for note in builder.notes]
    rounded = sorted(builder.terms.rounded)
    if rounded:
        names = ", ".join(rounded)
        note = f"values of {names} are irrational: they are rounded to {DIGITS} significant digits"
        warnings.append(Fault(note, severity="warning"))
    return model, tuple(warnings), _finder(declared, text)


def built(data: Mapping[str, Any]) -> tuple[Lifted, Builder, Model]:
    """The model of what the parsing process says.

    Raises:
        GroundingFault, ModelError: it is not right, or nothing that is read.
    """
    declared = lifted(data)
    builder = Builder(declared, Grounder(declared))
    return declared, builder, builder.model()


def _lines(text: str) -> str:
    """`text` with one kind of line end, and no byte order mark."""
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")


def _finder(declared: Lifted, text: Text) -> Locate:
    """Gives faults of the model the places of the definitions that they come from."""
    definitions = {name.removesuffix("'"): d.offset for name, d in declared.definitions.items()}

    def offset(path: tuple[str, ...]) -> int:
        if "reward" in path:
            return declared.nodes[declared.reward].offset
        if len(path) > 3 and path[2] in ("effects", "senses"):
            return definitions.get(path[3].partition("(")[0], -1)
        if path[:1] == ("terminal",) and declared.terminals:
            return declared.nodes[declared.terminals[0]].offset
        return -1

    def located(fault: Fault) -> Fault:
        file, line, column = text.place(offset(fault.path))
        return replace(fault, file=fault.file or file, line=line, column=column) if line else fault

    return lambda faults: tuple(fault if fault.line else located(fault) for fault in faults)
