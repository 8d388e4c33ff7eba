"""Text that is shown: names made harmless, numbers for people, and how wide a line will be.

Names come from model files, which are other people's: what is markup in HTML is escaped, control characters
and characters that change the direction of writing are shown as escapes.
"""

from __future__ import annotations

import html
import math
import unicodedata
from collections.abc import Iterable, Sequence
from typing import Final

from factored_polca.models import Value

LONGEST_NAME: Final = 32
"""Characters of a name in a picture; the whole one is in its tooltip."""

_ODD: Final = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


def printable(text: str) -> str:
    """`text` with characters that are not seen turned into escapes."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(ascii(c)[1:-1] if unicodedata.category(c) in _ODD else c for c in text)


def escape(text: object) -> str:
    """`text` for HTML and SVG, inside attributes too."""
    return html.escape(printable(str(text)), quote=True)


def short(text: str, most: int = LONGEST_NAME) -> str:
    """At most so many characters, the last an ellipsis where some were left out."""
    text = printable(text)
    return text if len(text) <= most else text[: most - 1].rstrip() + "…"


def value_text(value: Value) -> str:
    """A value of a feature."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def count_text(count: int) -> str:
    """A whole number, exact up to 40 digits; then its size."""
    if count < 10**40:
        return f"{count:,}"
    exponent = len(str(count)) - 1 if count < 10**4000 else int((count.bit_length() - 1) * math.log10(2))
    if count < 10**4000:
        return f"about {str(count)[0]}.{str(count)[1:4]} × 10^{exponent:,}"
    return f"about 10^{exponent:,}"


def number_text(value: float, digits: int = 5) -> str:
    """A number for people, with a true minus sign."""
    if math.isnan(value):
        return "–"
    if math.isinf(value):
        return "−∞" if value < 0 else "∞"
    text = f"{value:.{digits}g}"
    if "e" in text:
        mantissa, _, exponent = text.partition("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", "−")


def percent(share: float) -> str:
    """A probability or share; what is not quite 0 or 1 is not said to be."""
    if share <= 0 or share >= 1 - 1e-12:
        return "100 %" if share > 0 else "0 %"
    if share < 0.001:
        return "<0.1 %"
    if share > 0.995:
        return ">99 %"
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def seconds_text(seconds: float) -> str:
    """A duration."""
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


def plural(count: int, noun: str) -> str:
    """`1 block`, `2 blocks`."""
    return f"{count_text(count)} {noun}{'' if count == 1 else 's'}"


def listed(names: Iterable[str], most: int = 12, separator: str = ", ") -> str:
    """The first of some names, and how many more there are."""
    names = list(names)
    shown = [short(name) for name in names[:most]]
    if len(names) > most:
        shown.append(f"… {len(names) - most:,} more")
    return separator.join(shown)


def values_text(values: Sequence[Value], most: int = 8) -> str:
    """The values of a feature; a range of integers by its ends."""
    numbers = [v for v in values if isinstance(v, int) and not isinstance(v, bool)]
    if len(numbers) == len(values) > 2 and numbers == list(range(numbers[0], numbers[0] + len(numbers))):
        return f"{numbers[0]} … {numbers[-1]}"
    return listed([value_text(v) for v in values], most)


def wrapped(words: Iterable[str], most: int = 34, separator: str = " · ") -> list[str]:
    """Words on lines of at most so many characters, where a word allows it."""
    lines: list[str] = []
    for word in words:
        if lines and len(lines[-1]) + len(separator) + len(word) <= most:
            lines[-1] += separator + word
        else:
            lines.append(word)
    return lines


# -- widths ------------------------------------------------------------------------------------------

# Advance widths in hundredths of the font's size: those of DejaVu Sans, about the widest of the usual
# fonts without serifs, so that text in another one has room too.
_WIDTHS: Final = {
    27: "'", 28: "ijl", 29: "IJ", 32: " ,.·", 34: "/:;\\|", 35: "f", 36: "-", 39: "()[]t", 40: "!", 41: "r",
    46: '"', 50: "*_`–", 52: "sz", 53: "?", 55: "c", 56: "L", 58: "Fk", 59: "vxyγ", 60: "P", 61: "TYao",
    62: "e", 63: "ESbdghnpqu", 64: "${}0123456789", 66: "Kα", 68: "AV", 69: "BRXZ", 70: "C", 73: "U",
    75: "HN", 77: "DG", 78: "&", 79: "OQ", 82: "w", 84: "#+<=>^~≤≥≠−×→≈", 86: "M", 87: "∈", 95: "%",
    97: "m", 99: "W", 100: "@—…",
}  # fmt: skip
_WIDTH_OF: Final = {character: width for width, some in _WIDTHS.items() for character in some}
_BOLD: Final = 1.12


def text_width(text: str, size: float, bold: bool = False) -> float:
    """An upper estimate of a line's width, in the unit of `size`, the font's."""
    hundredths = 0.0
    for c in text:
        width = _WIDTH_OF.get(c)
        if width is None:
            wide = unicodedata.east_asian_width(c) in "WF"
            width = 110 if wide or ord(c) > 0xFFFF else 0 if unicodedata.combining(c) else 85
        hundredths += width
    return hundredths / 100 * size * (_BOLD if bold else 1.0)
