"""The files that the benchmark writes for other programs say what the arrays say."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from factored_polca import library
from factored_polca.formats import read
from factored_polca.minimisation.unreduced import unreduced_pomdp
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.symbolic import compile_model

SCRIPT = Path(__file__).parent / "benchmarks" / "pomdp.py"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    """The script `tests/benchmarks/pomdp.py`."""
    spec = importlib.util.spec_from_file_location("benchmark_of_pomdps", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("domain", "parameters"),
    [("tiger", {}), ("cheese", {}), ("hallway", {"size": 5}), ("rocksample", {"size": 2, "rocks": 1})],
)
def test_a_written_problem_is_the_problem(benchmark, domain, parameters, tmp_path):
    """Other programs refuse probabilities above 1, even by rounding; ours warns of rows that are not 1."""
    model = library.load(domain, parameters).model
    pomdp = unreduced_pomdp(compile_model(model), reachable=True)
    file = tmp_path / "problem.pomdp"
    assert benchmark.write_problem(pomdp, file) == ""
    lines = [line.split() for line in file.read_text(encoding="ascii").splitlines()]
    assert all(0 <= float(line[-1]) <= 1 for line in lines if line[0] in ("T:", "O:"))
    assert all(0 <= float(entry) <= 1 for line in lines if line[0] == "start:" for entry in line[1:])
    copy = unreduced_pomdp(compile_model(read(file).model), reachable=True)
    demand = Demand(gap=1e-4, iterations=300)
    one, other = (solve_pomdp(problem, "sarsop", demand=demand) for problem in (pomdp, copy))
    assert one.lower <= other.upper + 1e-9
    assert other.lower <= one.upper + 1e-9
    assert one.gap <= 0.1
    assert other.gap <= 0.1
