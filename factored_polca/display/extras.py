"""Libraries of optional extras, which are loaded when something needs them."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class MissingLibrary(ImportError):
    """A library of an optional extra is not installed; the message says how to install it."""


def library(name: str, extra: str, purpose: str) -> Any:
    """The module `name`.

    Raises:
        MissingLibrary: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        package = name.partition(".")[0]
        raise MissingLibrary(
            f"{purpose} needs {package}, which is not installed: pip install 'factored-polca[{extra}]'"
        ) from None
