"""The command line, `factored-polca`: thin, everything it does is in the library."""

from __future__ import annotations

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; answer the exit status (0 done, 2 wrong use or model, 3 a limit, 130 Ctrl-C)."""
    from factored_polca.cli.main import run

    return run(arguments)


__all__ = ["main"]
