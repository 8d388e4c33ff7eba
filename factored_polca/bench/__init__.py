"""Benchmarks: what minimisation takes, in one table, beside a peer's where one is installed.

`cases` lists what is run, `one_run` runs one case in a process of its own, `storm` the same with Storm,
`table` puts the rows together.  The command is `factored-polca bench`.
"""

from factored_polca.bench.cases import CASES, Case
from factored_polca.bench.runner import Row, run_cases

__all__ = ["CASES", "Case", "Row", "run_cases"]
