"""What stands behind an option: each function reads one kind of text, or says what would be right."""

from __future__ import annotations

import argparse
import re
from fractions import Fraction

REFERENCE = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)
TRIALS = 100
FLAT_TRIALS = 300
ORDERS = ("auto", "file", "force", "spectral")
FLAT_SOLVERS = (
    "auto", "exact", "witness", "pbvi", "perseus", "hsvi", "sarsop", "qmdp", "fib", "blind", "amdp", "vi",
    "pi", "mpi", "structured", "symbolic",
)  # fmt: skip


def solver(text: str) -> str:
    """The name of a solver of ours, or `package.module:Name`."""
    if text not in FLAT_SOLVERS and REFERENCE.fullmatch(text) is None:
        listed = ", ".join(FLAT_SOLVERS)
        raise argparse.ArgumentTypeError(f"{text!r} is none of {listed}, nor written package.module:Name")
    return text


def natural(text: str) -> int:
    """A whole number from 0 on."""
    if not text.isdecimal() or len(text) > 15:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text)


def counting(text: str) -> int:
    """A whole number from 1 on."""
    value = natural(text)
    if value < 1:
        raise argparse.ArgumentTypeError("it must be at least 1")
    return value


UNITS = {"": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12, "ki": 2**10, "mi": 2**20, "gi": 2**30}


def size(text: str) -> int:
    """`2GB`, `500MiB` or a plain number of bytes."""
    match = re.fullmatch(r"\s*([0-9]{1,15}(?:\.[0-9]{1,9})?)\s*([kmgt]|[kmg]i)?b?\s*", text.lower())
    if match is None or float(match[1]) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is no size such as 2GB or 500MiB")
    return int(float(match[1]) * UNITS[match[2] or ""])


def positive(text: str) -> float:
    """A positive number."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
    return value


def gap(text: str) -> float:
    """A positive number, for the width of bounds."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number such as 0.001")
    return value


def horizon(text: str) -> int | str:
    """A number of steps, or "infinite"."""
    if text in ("infinite", "inf"):
        return "infinite"
    if not text.isdecimal() or not 0 < len(text) <= 15 or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number of steps from 1 on nor infinite")
    return int(text)


def discount(text: str) -> Fraction:
    """An exact number from 0 to 1: a decimal or a fraction."""
    if re.fullmatch(r"[0-9]{0,30}\.?[0-9]{1,30}|[0-9]{1,30}/[0-9]{0,29}[1-9][0-9]{0,29}", text):
        value = Fraction(text)
        if 0 <= value <= 1:
            return value
    raise argparse.ArgumentTypeError(f"{text!r} is no number from 0 to 1 such as 0.95 or 19/20")
