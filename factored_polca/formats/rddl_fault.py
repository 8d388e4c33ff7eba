"""The fault of an RDDL text that a place belongs to."""

from __future__ import annotations


class GroundingFault(Exception):
    """Something in the text is at fault, at the character numbered `offset` (-1: unknown)."""

    def __init__(self, message: str, offset: int, hint: str = "") -> None:
        super().__init__(message)
        self.offset, self.hint = offset, hint
