"""The options of the command `sensitivity`, and `--keep-parameters` of `minimise`."""

from __future__ import annotations

import argparse
import re
from fractions import Fraction

from factored_polca.cli.argument_types import FLAT_SOLVERS, counting, gap

NOTES = """the parameters of the ranges stay symbols while the model is minimised, once; the others have the
values of the model, or of --set.  The quotient is then solved at every setting: with two ranges, at each
pair.

  factored-polca sensitivity tiger --set-range accuracy=0.5..1:51
  factored-polca sensitivity taxi --set slip=0.2 --set-range slip=0..0.5:1001 -o slip.png
  factored-polca sensitivity robot.toml --set-range p=0..1:21 --set-range q=0..1/2:21 -o robot.csv

A setting at which a probability is not between 0 and 1, or something is divided by 0, has no value; the
output says why.

exit status: 0 with a result, also where --time stopped it; 130 after Ctrl-C, with what was done printed
and written; 3 where memory or another limit was reached.
"""

RANGE = re.compile(
    r"(?P<name>[^=]+)=(?P<low>[^=.]*\.?[^=.]+)\.\.(?P<high>[^=:]+?)(?::(?P<count>[0-9]{1,7}))?"
)
NUMBER = re.compile(
    r"[+-]?(?:[0-9]{1,30}(?:\.[0-9]{0,30})?|\.[0-9]{1,30})(?:/[0-9]{0,29}[1-9][0-9]{0,29})?"
)
COUNT = 101


def span(text: str) -> tuple[str, Fraction, Fraction, int]:
    """`p=0.1..0.9:101` as a name, two exact numbers and how many values there are from one to the other."""
    match = RANGE.fullmatch(text.strip())
    hint = f"{text!r} is no range such as p=0.1..0.9:101 or p=0..1/2"
    if match is None:
        raise argparse.ArgumentTypeError(hint)
    low, high = exact(match["low"], hint), exact(match["high"], hint)
    count = COUNT if match["count"] is None else counting(match["count"])
    if high < low or (count == 1) != (low == high):
        raise argparse.ArgumentTypeError(
            f"{text!r}: LOW must be below HIGH and COUNT at least 2, or all one value: p=0.3..0.3:1"
        )
    return match["name"].strip(), low, high, count


def exact(text: str, hint: str) -> Fraction:
    """A decimal or a fraction."""
    if NUMBER.fullmatch(text.strip()) is None:
        raise argparse.ArgumentTypeError(hint)
    top, _, bottom = text.strip().partition("/")
    return Fraction(top) / Fraction(bottom or 1)


def kept_names(text: str) -> tuple[str, ...]:
    """`a,b` as names; nothing as none."""
    return tuple(name.strip() for name in text.split(",") if name.strip())


def add_keeping(sub: argparse.ArgumentParser) -> None:
    """`--keep-parameters` or `--keep-parameters=A,B`."""
    sub.add_argument(
        "--keep-parameters", nargs="?", const=(), type=kept_names, metavar="A,B,...",
        help="parameters stay symbols: the partition is right for all their values; all of the model's, or "
        "those named (write --keep-parameters=A,B)",
    )  # fmt: skip


def add_sensitivity(sub: argparse.ArgumentParser) -> None:
    """The ranges, how each setting is solved, and where the result goes."""
    sub.epilog, sub.formatter_class = NOTES, argparse.RawDescriptionHelpFormatter
    sub.add_argument(
        "--set-range", action="append", type=span, required=True, metavar="NAME=LOW..HIGH[:COUNT]",
        help=f"values of a parameter, equally spaced, both ends included ({COUNT} if not said); may be "
        "given for several",
    )  # fmt: skip
    sub.add_argument(
        "--gap", type=gap, metavar="G",
        help="width of the bounds: where the state is seen a share of the largest value (1e-9), else as it "
        "is (0.001)",
    )  # fmt: skip
    sub.add_argument(
        "--solver", default="auto", metavar="NAME",
        choices=[name for name in FLAT_SOLVERS if name not in ("vi", "pi", "mpi", "witness")],
        help="where the state is not seen, as for solve; policy iteration where it is",
    )  # fmt: skip
    sub.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        help="draw it as .png or .svg (needs matplotlib), or list it as .csv",
    )
