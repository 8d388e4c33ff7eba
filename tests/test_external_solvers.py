"""Solvers on the PATH, played by small scripts: what they get, what is read back, and when they fail.

That files say the same as the arrays is tested by our own reader and solver; the programs
themselves are not needed (`pomdp-solve` and `pomdpsol` pass `check_solver`).
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from small_pomdps import SEEDS, cheese, random_pomdp, tiger

from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.external.array_files import lay_out
from factored_polca.external.programs import PomdpSolve, Sarsop, run
from factored_polca.formats.cassandra import read_pomdp
from factored_polca.minimisation.unreduced import unreduced
from factored_polca.models import LimitReached, ModelError
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.protocol import call_pomdp_solver
from factored_polca.symbolic import compile_model

TIGER = tiger(0.95)


def read_back(text: str) -> ArrayPOMDP:
    return unreduced(compile_model(read_pomdp(text, "written")), reachable=True).pomdp


def best(pomdp: ArrayPOMDP) -> tuple[float, float]:
    found = solve_pomdp(pomdp, "exact", demand=Demand(gap=1e-7))
    return found.lower, found.upper


# -- the file --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_a_file_for_one_start_has_the_value_of_the_arrays(seed: int) -> None:
    """Where what is seen at the start matters, for each part; terminal and mixed ones are among them."""
    pomdp = random_pomdp(seed)
    for root in prepare(pomdp).roots:
        start = prepare(pomdp).belief(root.y, root.belief)
        alone = ArrayPOMDP(**{**vars(pomdp), "initial": start})
        low, high = best(alone)
        lower, upper = best(read_back(lay_out(pomdp, [start]).text))
        assert lower <= high + 1e-6
        assert upper >= low - 1e-6


@pytest.mark.parametrize("seed", SEEDS)
def test_a_file_for_several_starts_has_their_mean_one_step_later(seed: int) -> None:
    pomdp = random_pomdp(seed)
    problem = prepare(pomdp, np.eye(pomdp.states)[~pomdp.terminal])
    starts = [problem.belief(root.y, root.belief) for root in problem.roots]
    corners = np.eye(pomdp.states)[~pomdp.terminal]
    found = solve_pomdp(pomdp, "exact", demand=Demand(gap=1e-7), roots=corners)
    expected = pomdp.discount * float(found.root_lower.mean())
    lower, upper = best(read_back(lay_out(pomdp, starts).text))
    assert lower - 1e-6 <= expected <= upper + 1e-6


def test_states_are_split_only_where_the_kernel_does_not_factor() -> None:
    assert lay_out(TIGER, [TIGER.initial]).states == 2
    assert lay_out(cheese(), [cheese().initial]).states == 11
    kernel = [[np.array([[0.5, 0.0], [0.0, 0.5]]), np.array([[0.0, 0.5], [0.5, 0.0]])]]
    from factored_polca.explicit.pomdp_arrays import array_pomdp

    moved = array_pomdp(kernel, np.array([[1.0, 0.0]]), np.array([1.0, 0.0]), 0.9)
    layout = lay_out(moved, [moved.initial])
    assert layout.states == 4
    table = np.arange(4.0)[None, :]
    assert layout.vectors(table).shape == (1, 2)


# -- programs --------------------------------------------------------------------------------------

VECTORS = {  # vectors for the tiger that pomdp-solve writes; their policy is the best one
    0: [(19.3713683559, 19.3713683559), (0.6908881394, 25.0049727346), (25.0049727346, 0.6908881394)],
    1: [(-81.5972000619, 28.4027999381)],
    2: [(28.4027999381, -81.5972000619)],
}
ALPHA = "".join(f"{a}\n{x} {y}\n\n" for a, found in VECTORS.items() for x, y in found)
POLICY = (
    '<?xml version="1.0"?><Policy type="value"><AlphaVector vectorLength="2" numObsValue="1">'
    + "".join(
        f'<Vector action="{a}" obsValue="0">{x} {y} </Vector>' for a, f in VECTORS.items() for x, y in f[:2]
    )
    + '<SparseVector action="0"><Entry>0 25.0049727346</Entry><Entry>1 0.69</Entry></SparseVector>'
    + "</AlphaVector></Policy>"
)


def program(folder: Path, name: str, body: str) -> None:
    """An executable that runs `body`, with `out` the file it has to write."""
    path = folder / name
    path.write_text(
        f"#!{sys.executable}\nimport os, sys, time\nfrom pathlib import Path\n"
        f"out = {'found.alpha' if name == 'pomdp-solve' else 'found.policy'!r}\n{body}\n"
    )
    path.chmod(0o755)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is the whole PATH."""
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


BOTH = [("pomdp-solve", PomdpSolve(seconds=60), ALPHA), ("pomdpsol", Sarsop(seconds=60), POLICY)]


@pytest.mark.parametrize(("name", "solver", "text"), BOTH)
def test_vectors_come_back_as_a_policy_with_bounds_of_our_own(
    folder: Path, name: str, solver: PomdpSolve | Sarsop, text: str
) -> None:
    program(folder, name, f"Path(out).write_text({text!r}); Path({str(folder)!r}, 'seen').write_text("
            "Path('problem.pomdp').read_text() + ' '.join(sys.argv))")  # fmt: skip
    found = call_pomdp_solver(solver, TIGER, Demand(gap=1e-3))
    assert found.method == name
    assert 19.36 < found.lower <= 19.371369 <= found.upper
    assert "vectors by" in found.note
    seen = (folder / "seen").read_text()
    assert "discount: 0.95" in seen
    assert "problem.pomdp" in seen.splitlines()[-1]


# The end of what pomdpsol prints for the tiger.
TABLE = """
 Time   |#Trial |#Backup |LBound    |UBound    |Precision  |#Alphas |#Beliefs
-------------------------------------------------------------------------------
 0       0       0        -20        92.8205    112.821     3        1
 0.01    18      78       19.3713    19.3723    0.000983243 29       19
-------------------------------------------------------------------------------
"""


def test_what_pomdpsol_says_of_its_bounds_is_told_as_its_claim(folder: Path) -> None:
    program(folder, "pomdpsol", f"print({TABLE!r}); Path(out).write_text({POLICY!r})")
    found = call_pomdp_solver(Sarsop(), TIGER, Demand(gap=1e-3))
    assert "it claims 19.3713 .. 19.3723 at the start" in found.note
    assert found.upper > 19.3723  # ours is what we can prove of the policy
    liar = TABLE.replace("19.3723", "1e-3")
    program(folder, "pomdpsol", f"print({liar!r}); Path(out).write_text({POLICY!r})")
    again = call_pomdp_solver(Sarsop(), TIGER, Demand(gap=1e-3))
    assert (again.lower, again.upper) == (found.lower, found.upper)


def test_promises_are_not_believed(folder: Path) -> None:
    program(folder, "pomdp-solve", "Path(out).write_text('1\\n1000 1000\\n')")
    found = call_pomdp_solver(PomdpSolve(), TIGER, Demand(gap=1e-3))
    assert found.lower < -100


def test_further_starts_are_kept_apart(folder: Path) -> None:
    """With roots the file has one more state and a copy of each root's states: 2 + 2 + 1 + 1 + 1 states."""
    row = " ".join(["1"] * 7)
    body = f"Path(out).write_text('<P><Vector action=\"0\">{row}</Vector></P>')"
    program(folder, "pomdpsol", body)
    found = call_pomdp_solver(Sarsop(), TIGER, Demand(gap=1e-3), np.eye(2))
    assert found.lower == pytest.approx(-20, abs=1e-6)  # listening for ever
    assert len(found.root_lower) == 3


@pytest.mark.parametrize(
    ("name", "solver", "body", "said"),
    [
        ("pomdp-solve", PomdpSolve(), "print('no licence'); sys.exit(3)", "it said: no licence"),
        ("pomdp-solve", PomdpSolve(), "Path(out).write_text('')", "no vector at all"),
        ("pomdp-solve", PomdpSolve(), "Path(out).write_text('0\\n1 2 3\\n')", "3 numbers for 2 states"),
        ("pomdp-solve", PomdpSolve(), "Path(out).write_text('0\\n1 nan\\n')", "not finite"),
        ("pomdp-solve", PomdpSolve(), "Path(out).write_text('0\\n1 x\\n')", "could not convert"),
        ("pomdp-solve", PomdpSolve(), "Path(out).write_text('0 1\\n1 1\\n')", "more than a number"),
        ("pomdp-solve", PomdpSolve(), "Path(out).write_text('7\\n1 1\\n')", "an action outside 0 .. 2"),
        ("pomdp-solve", PomdpSolve(), "os.symlink('/etc/passwd', out)", "wrote no policy"),
        ("pomdpsol", Sarsop(), "Path(out).write_text('<P>')", "can't be read"),
        ("pomdpsol", Sarsop(), "Path(out).write_text('<P></P>')", "no vectors"),
        ("pomdpsol", Sarsop(), "Path(out).write_text('<Vector action=\"-1\">1 1</Vector>')", "whole"),
        (
            "pomdpsol", Sarsop(),
            "Path(out).write_text('<P><SparseVector action=\"0\"><Entry>9 1</Entry></SparseVector></P>')",
            "no place and number",
        ),
        (
            "pomdpsol", Sarsop(),
            "Path(out).write_text('<!DOCTYPE a [<!ENTITY b \"c\">]><Vector action=\"0\">&b;</Vector>')",
            "can't be read",
        ),
    ],
)  # fmt: skip
def test_what_a_program_did_wrong_is_said(
    folder: Path, name: str, solver: PomdpSolve | Sarsop, body: str, said: str
) -> None:
    program(folder, name, body)
    with pytest.raises(ModelError, match=said):
        solver(TIGER, Demand(), None)


@pytest.mark.parametrize("solver", [PomdpSolve(), Sarsop()])
def test_a_program_that_is_not_there_is_named(folder: Path, solver: PomdpSolve | Sarsop) -> None:
    with pytest.raises(ModelError, match=f"{solver.program} is not on the PATH"):
        solver(TIGER, Demand(), None)


def test_a_program_that_does_not_end_is_ended_with_what_it_started(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("factored_polca.external.programs.GRACE_SECONDS", 1.0)
    mark = folder / "child"
    program(
        folder, "pomdp-solve",
        f"import subprocess\nc = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        f"Path({str(mark)!r}).write_text(str(c.pid))\ntime.sleep(600)",
    )  # fmt: skip
    with pytest.raises(LimitReached, match="wrote no policy within"):
        PomdpSolve(seconds=1.0)(TIGER, Demand(), None)
    child = int(mark.read_text())
    for _ in range(100):
        if not Path(f"/proc/{child}").exists() or "Z" in Path(f"/proc/{child}/stat").read_text().split()[2]:
            break
        time.sleep(0.05)
    else:
        pytest.fail("the program's child lives on")


def test_what_a_late_program_has_written_counts(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factored_polca.external.programs.GRACE_SECONDS", 2.0)
    program(folder, "pomdp-solve", f"Path(out).write_text({ALPHA!r})\ntime.sleep(600)")
    found = PomdpSolve(seconds=0.5)(TIGER, Demand(gap=1e-12), None)
    assert found.status == "iteration limit"
    assert "ended after 0.5 s" in found.note
    assert found.lower > 19.36


def test_nothing_is_started_for_a_problem_that_is_over(folder: Path) -> None:
    program(folder, "pomdp-solve", "sys.exit(1)")
    from factored_polca.testing.problems import ended

    found = call_pomdp_solver(PomdpSolve(), ended().pomdp, Demand())
    assert (found.lower, found.upper) == (0.0, 0.0)


def test_no_shell_reads_the_command(tmp_path: Path) -> None:
    printed, late = run(
        [sys.executable, "-c", "import sys; print(sys.argv[1])", "$(id); `id` | cat"], tmp_path, 30
    )
    assert printed.strip() == "$(id); `id` | cat"
    assert not late
    assert os.listdir(tmp_path) == ["printed"]
