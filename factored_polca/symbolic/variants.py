"""Numbers that tell models over one manager apart: what it remembers of regressions goes by them."""

from __future__ import annotations

from itertools import count

_numbers = count(1)


def fresh_variant() -> int:
    """A number that no other model has; 0 is that of a compiled model itself."""
    return next(_numbers)
