"""The command line, `factored-polca`: thin, everything it does is in the library."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Final

BLAS_THREADS: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Where libraries under numpy read how many threads they may use: one, unless somebody has said otherwise.

Products here are small.  Threads make them slower, much so where others compute too, and they change the
order of sums, so that equal seeds would give equal results only for equal numbers of threads.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; answer the exit status (0 done, 2 wrong use or model, 3 a limit, 130 Ctrl-C)."""
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")
    try:
        from factored_polca.cli.entry import run

        return run(arguments)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


__all__ = ["main"]
