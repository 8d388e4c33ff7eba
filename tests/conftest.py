"""Shared settings of the tests; `pythonpath` in pyproject.toml makes `import random_models` work.

Tests marked `data` try the program on other people's model files: they read the folder that
FACTORED_POLCA_DATA names, and are deselected where it is not set.
"""

import os
import signal

import pytest

from factored_polca.cli import BLAS_THREADS

# Before numpy is loaded, as the command line does.
for name in BLAS_THREADS:
    os.environ.setdefault(name, "1")

# A shell that starts a command in the background without job control has it ignore Ctrl-C, and processes
# hand that down.  Tests that interrupt processes would then wait for ever.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not os.environ.get("FACTORED_POLCA_DATA"):
        dropped = [item for item in items if item.get_closest_marker("data")]
        if dropped:
            items[:] = [item for item in items if not item.get_closest_marker("data")]
            config.hook.pytest_deselected(items=dropped)
