"""The command line, `factored-polca`: thin, everything it does is in the library."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; answer the exit status (0 done, 2 wrong use or model, 3 a limit, 130 Ctrl-C)."""
    try:
        from factored_polca.cli.entry import run

        return run(arguments)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


__all__ = ["main"]
