"""Compile or load the kernels of a POMDP method ahead of the work, so that times are times of the work.

A walk on a ring of cells, some of them told apart (two classes), seen through a noisy sensor, is solved
for a moment: large enough that no solver takes its way for tiny problems, with beliefs that never
close, so that every kernel of the method is called.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.solvers.finite_horizon import solve_finite_horizon
from factored_polca.solvers.graph_iteration import solve_by_graph_iteration
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.sarsop import STYLE
from factored_polca.solvers.tree_beliefs import rehash
from factored_polca.solvers.tree_search import MEMORY_LIMIT, Search
from factored_polca.solvers.unfolding import solve_by_unfolding

CELLS: Final = 8


def ring(cells: int = CELLS) -> ArrayPOMDP:
    """Step left or right on a ring, or stay and look; cell 0 pays for staying, and ends a run."""
    places = np.arange(cells)
    right = np.where((places[:, None] % 3 == np.arange(3)[None, :]), 0.7, 0.15)  # [t, o]
    kernel, rewards = [], []
    for step, reward in ((-1, -0.1), (1, -0.1), (0, 0.0)):
        moves = np.zeros((cells, cells))
        moves[places, (places + step) % cells] += 0.8
        moves[places, places] += 0.2
        moves[0] = 0.0
        kernel.append([moves * right[None, :, o] for o in range(3)])
        rewards.append(np.where(places == 0, 0.0, reward + (places == 1)))
    return array_pomdp(
        kernel,
        np.array(rewards),
        np.append(0.0, np.full(cells - 1, 1 / (cells - 1))),
        0.9,
        terminal=places == 0,
        observed=(places == cells - 1).astype(np.int64),
    )


def _ended(found: POMDPSolution) -> None:
    """Solvers keep Ctrl-C to themselves: here nobody wants the result, so it is raised once more."""
    if found.status == "interrupted":
        raise KeyboardInterrupt


def _search(pomdp: ArrayPOMDP) -> None:
    run = Search(prepare(pomdp), Demand(gap=1e-9, iterations=120), STYLE, MEMORY_LIMIT)
    _ended(run.solution(run.run()))
    rehash(run.tree)  # needed by long searches only


def _rounds(name: str) -> Callable[[ArrayPOMDP], None]:
    def run(pomdp: ArrayPOMDP) -> None:
        _ended(solve_pomdp(pomdp, name, demand=Demand(gap=1e-3, iterations=3)))

    return run


def _exact(pomdp: ArrayPOMDP) -> None:
    problem = prepare(ring(6))
    _ended(solve_by_unfolding(problem, Demand(gap=1e-3), beliefs=30))
    _ended(solve_by_graph_iteration(problem, Demand(gap=1e-3, iterations=1)))
    _search(pomdp)


def _staged(_: ArrayPOMDP) -> None:
    _ended(solve_finite_horizon(prepare(ring(6)), 4, Demand(gap=1e-3)))


def _witness(_: ArrayPOMDP) -> None:
    _ended(solve_finite_horizon(prepare(ring(6)), 3, Demand(gap=1e-3), method="witness"))


_WORK: Final[Mapping[str, Callable[[ArrayPOMDP], None]]] = {
    "auto": _exact,
    "exact": _exact,
    "witness": _witness,
    "hsvi": _search,
    "sarsop": _search,
}


def warm_up(method: str, *, staged: bool = False) -> float:
    """Compile, or load from disk, the kernels that `method` needs; answer the seconds it took.

    `staged`: for a finite horizon.
    """
    began = time.perf_counter()
    work = _staged if staged and method != "witness" else _WORK.get(method, _rounds(method))
    work(ring())
    return time.perf_counter() - began
