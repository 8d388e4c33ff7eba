"""The shipped domains: which there are, what they take, and loading one by name.

A domain is a file `NAME.py` with a docstring (what it is, its source, what the source reports) and

    model(**parameters) -> Model        tasks(**parameters) -> TaskHierarchy | None

both with the same keyword parameters, each annotated `Annotated[type, "what it means"]` and with a
default.  The repository keeps these files in `domains/` at its top; an installed package carries
them as `factored_polca/domains/`.  Only names found in that folder are ever loaded.
"""

from __future__ import annotations

import difflib
import importlib.util
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import Annotated, Any, Final, TypeAlias, Union, get_args, get_origin, get_type_hints

from factored_polca.models import Fault, Model, ModelError, TaskHierarchy
from factored_polca.models.model import rational
from factored_polca.models.rational_functions import FunctionField, RationalFunction, SymbolUsed
from factored_polca.models.written_out import with_parameters_written_out

Number: TypeAlias = Fraction | str | float
"""A number as a domain takes it; a text or a float means its decimal exactly ("0.1" is 1/10)."""

_NAME: Final = re.compile(r"[a-z][a-z0-9_]*")
_INTEGER: Final = re.compile(r"[+-]?[0-9]{1,12}")
_TRUTH: Final = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}


@dataclass(frozen=True)
class Domain:
    """A domain with its parameters set: the model and its task hierarchy, if it has one."""

    name: str
    model: Model
    tasks: TaskHierarchy | None


@dataclass(frozen=True)
class ParameterDescription:
    """A parameter of a domain: `kind` names the type of its values, `default` is one of them."""

    name: str
    default: object
    kind: str
    documentation: str


@dataclass(frozen=True)
class DomainDescription:
    """What a domain is: `summary` is the first line of `documentation`."""

    name: str
    summary: str
    documentation: str
    parameters: tuple[ParameterDescription, ...]


# --------------------------------------------------------------------------------------------
# Finding and loading
# --------------------------------------------------------------------------------------------


def folder() -> Path:
    """The folder of the shipped domains: beside this file, or at the top of the repository.

    Raises:
        FileNotFoundError: there is neither; the message says what to do.
    """
    installed = Path(__file__).resolve().parent / "domains"
    if installed.is_dir():
        return installed
    top = installed.parent.parent
    if (top / "domains").is_dir() and (top / "pyproject.toml").is_file():
        return top / "domains"
    raise FileNotFoundError(
        f"the shipped domains are missing: neither {installed} nor {top / 'domains'} is there; "
        "install the package again"
    )


def domains() -> tuple[str, ...]:
    """The names of the shipped domains, in alphabetical order."""
    return tuple(sorted(path.stem for path in folder().glob("*.py") if _NAME.fullmatch(path.stem)))


def load(name: str, parameters: Mapping[str, object] | None = None, *, keep: Iterable[str] = ()) -> Domain:
    """The domain `name` with `parameters`; a text such as "10" is read as the parameter's type says.

    Parameters that `keep` names become parameters of the model, with their value as a number that can
    still be changed; the others are worked in.

    Raises:
        ModelError: no such domain or parameter, or a value that the domain refuses; the message
            lists what is allowed.
    """
    module = _module(name)
    values = {key: _convert(name, key, value) for key, value in _known(name, parameters or {}).items()}
    try:
        tasks = module.tasks(**values)
        kept = _kept(name, values, keep)
        if not kept:
            return Domain(name, module.model(**values), tasks)
        field = FunctionField(tuple(kept))
        model = module.model(**{**values, **{key: field.symbol(key) for key in kept}})
        return Domain(name, with_parameters_written_out(model, kept), tasks)
    except SymbolUsed as error:
        listed = ", ".join(kept)
        message = f"{listed} can't stay a symbol: the domain needs its value to make the model"
        raise ModelError([Fault(message, file=name)]) from error
    except ModelError as error:
        raise error.in_file(name) from None


def numeric_parameters(name: str) -> tuple[str, ...]:
    """The parameters of a domain that are numbers of its model: those of the kind number, the discount not.

    Raises:
        ModelError: no such domain.
    """
    found = _parameters(_module(name).model)
    return tuple(
        key for key, (_, hint, _) in found.items() if key != "discount" and _kind(hint) == "number"
    )


def _kept(name: str, values: Mapping[str, object], keep: Iterable[str]) -> dict[str, Fraction]:
    """The values of the parameters that stay symbols."""
    known = _parameters(_module(name).model)
    _known(name, dict.fromkeys(keep))
    kept = {}
    for key in dict.fromkeys(keep):
        if key == "discount":
            raise ModelError([Fault("the discount can't stay a symbol", (key,), "it is no probability")])
        kept[key] = number(key, values.get(key, known[key][0].default))
    return kept


def describe(name: str) -> DomainDescription:
    """What the domain `name` is and which parameters it takes.

    Raises:
        ModelError: no such domain; the message lists those there are.
    """
    module = _module(name)
    documentation = inspect.cleandoc(module.__doc__ or "")
    parameters = tuple(
        ParameterDescription(key, parameter.default, _kind(hint), documented)
        for key, (parameter, hint, documented) in _parameters(module.model).items()
    )
    return DomainDescription(name, documentation.partition("\n")[0], documentation, parameters)


def _module(name: str) -> ModuleType:
    names = domains()
    if name not in names:
        near = difflib.get_close_matches(name, names, n=1)
        guess = f"; did you mean {near[0]!r}?" if near else ""
        raise ModelError(f"no domain {name!r}; there are {', '.join(names)}{guess}")
    qualified = f"factored_polca.domains.{name}"
    if qualified in sys.modules:
        return sys.modules[qualified]
    spec = importlib.util.spec_from_file_location(qualified, folder() / f"{name}.py")
    assert spec is not None, "a .py file always has a loader"
    assert spec.loader is not None, "a .py file always has a loader"
    module = importlib.util.module_from_spec(spec)
    sys.modules[qualified] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[qualified]
        raise
    return module


# --------------------------------------------------------------------------------------------
# Parameters given as text
# --------------------------------------------------------------------------------------------


def _parameters(function: Callable[..., Any]) -> dict[str, tuple[inspect.Parameter, Any, str]]:
    """Name -> (parameter, type, documentation)."""
    hints = get_type_hints(function, include_extras=True)
    result = {}
    for key, parameter in inspect.signature(function).parameters.items():
        hint, documented = hints[key], ""
        if get_origin(hint) is Annotated:
            hint, documented = get_args(hint)[:2]
        result[key] = (parameter, hint, documented)
    return result


def _known(name: str, parameters: Mapping[str, object]) -> Mapping[str, object]:
    known = tuple(_parameters(_module(name).model))
    faults = []
    for key in parameters:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            guess = f"; did you mean {near[0]!r}?" if near else ""
            faults.append(Fault(f"no parameter {key!r}{guess}", (key,), f"it has {', '.join(known)}", name))
    if faults:
        raise ModelError(faults)
    return parameters


def _types(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _kind(hint: Any) -> str:
    types = _types(hint)
    if Fraction in types:
        return "number"
    titles = {int: "integer", bool: "true or false", str: "text", NoneType: "none"}
    return " or ".join(titles.get(kind, str(kind)) for kind in types)


def _convert(name: str, key: str, value: object) -> object:
    """`value` as the parameter `key` takes it; what is no text is left to the domain to check."""
    if not isinstance(value, str):
        return value
    _, hint, documented = _parameters(_module(name).model)[key]
    types, text = _types(hint), value.strip()
    if bool in types and text.lower() in _TRUTH:
        return _TRUTH[text.lower()]
    if int in types and _INTEGER.fullmatch(text):
        return int(text)
    if Fraction in types:
        try:
            return rational(text)
        except (ModelError, TypeError):
            pass
    elif str in types:
        return text
    expected = f"{key} is {_kind(hint)}"
    hint_text = f"{expected}: {documented}" if documented else expected
    raise ModelError([Fault(f"{value!r} is no value of {key!r}", (key,), hint_text, name)])


# --------------------------------------------------------------------------------------------
# What domains check their parameters with
# --------------------------------------------------------------------------------------------


def integer(name: str, value: object, least: int, most: int) -> int:
    """`value`, if it is an integer from `least` to `most`.

    Raises:
        ModelError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise _refused(name, value, f"an integer from {least} to {most}")
    return value


def number(name: str, value: object) -> Fraction:
    """`value` as an exact rational.

    Raises:
        ModelError: it is no number.
    """
    try:
        if not isinstance(value, bool):
            return rational(value)
    except (ModelError, TypeError):
        pass
    raise _refused(name, value, "a number such as 3, 0.1 or 1/3")


def probability(name: str, value: object) -> Fraction:
    """`value` as an exact rational from 0 to 1.

    Raises:
        ModelError: it is none.
    """
    chance = number(name, value)
    if isinstance(chance, RationalFunction):
        return chance  # whose values are asked for later
    if not 0 <= chance <= 1:
        raise _refused(name, value, "a probability from 0 to 1")
    return chance


def discount_factor(value: object) -> Fraction:
    """`value` as a discount from 0 to 1; whether 1 is sound for the model is a later check.

    Raises:
        ModelError: it is none.
    """
    discount = number("discount", value)
    if not 0 <= discount <= 1:
        raise _refused("discount", value, "a number from 0 to 1")
    return discount


def truth(name: str, value: object) -> bool:
    """`value`, if it is true or false.

    Raises:
        ModelError: it is not.
    """
    if not isinstance(value, bool):
        raise _refused(name, value, "true or false")
    return value


def choice(name: str, value: object, allowed: tuple[str, ...]) -> str:
    """`value`, if it is one of `allowed`.

    Raises:
        ModelError: it is not; the message lists them.
    """
    if not isinstance(value, str) or value not in allowed:
        raise _refused(name, value, f"one of {', '.join(allowed)}")
    return value


def _refused(name: str, value: object, rule: str) -> ModelError:
    return ModelError([Fault(f"{name} is {value!r}", (name,), f"it must be {rule}")])
