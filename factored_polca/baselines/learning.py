"""The loop over episodes: exploration, learning rate, and what is measured on the way.

    exploration   epsilon-greedy at each choice of each task; epsilon falls linearly from `exploration` to 0
                  over the first half of the episodes and is 0 from then on
    rate          alpha = (1 + n)^-0.51 for an entry that was updated n times before, so that the sum of the
                  rates diverges and that of their squares converges (Dietterich 2000, Eq. 15)
    start         all values are 0

Measured at checkpoints, whose distances grow geometrically: the exact discounted return of the greedy
policy (`return_of_greedy`), and the mean return of the episodes since the checkpoint before, exploration
included.  That mean is taken relative to the optimum of each episode's own start,

    mean over starts of V*(s) + mean over episodes of (return - V*(s_0)),

which has the same expectation without the luck of the starts, and is the optimum where all is optimal and
nothing is random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from factored_polca.baselines.process import ProcessArrays, SampledProcess
from factored_polca.baselines.return_of_greedy import return_of_greedy
from factored_polca.baselines.tables import Table, TableArrays
from factored_polca.baselines.task_graph import NONE, GraphArrays, TaskGraph
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.models import ModelError
from factored_polca.solvers import solve_mdp
from factored_polca.solvers.compiled import kernel

EPISODES: Final = 40_000
STEP_LIMIT: Final = 5_000
"""Steps after which an episode is broken off."""
RATE_POWER: Final = 0.51
BATCH: Final = 1_000
"""Episodes that one call of a kernel learns from; Ctrl-C is seen between calls."""
CLOSE: Final = 0.02
"""How close to the optimal return counts as there, relative to it."""


class Knobs(NamedTuple):
    """What the kernels read of a schedule."""

    discount: float
    exploration: float
    fading: float  # episodes until epsilon is 0
    power: float
    limit: int


class Record(NamedTuple):
    """What the kernels write down of each episode."""

    returns: FloatArray  # [episode] discounted
    starts: IntArray  # [episode] the first state
    steps: IntArray  # [episode]


Episodes = Callable[
    [ProcessArrays, GraphArrays, tuple[TableArrays, ...], Knobs, int, int, Record, Any], None
]
GreedyChoice = Callable[[GraphArrays, tuple[TableArrays, ...], IntArray], None]


@dataclass(frozen=True, eq=False)
class Method:
    """A learner: its task graph, its tables, and the two kernels that fill and read them."""

    name: str
    graph: TaskGraph
    tables: tuple[Table, ...]
    episodes: Episodes
    greedy: GreedyChoice

    @property
    def stored_values(self) -> int:
        """The allocated entries of all its tables."""
        return sum(table.size for table in self.tables)


@dataclass(frozen=True)
class Schedule:
    """How long and how to learn."""

    episodes: int = EPISODES
    exploration: float = 0.3
    checkpoints: int = 100

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ModelError(f"{self.episodes} episodes: give at least 1")
        if not 0 <= self.exploration <= 1:
            raise ModelError(f"exploration is {self.exploration}: it is a probability")

    def knobs(self, discount: float) -> Knobs:
        """The numbers for the kernels."""
        return Knobs(discount, self.exploration, self.episodes / 2, RATE_POWER, STEP_LIMIT)

    def points(self) -> list[int]:
        """The numbers of episodes after which is measured, the last being all."""
        spread = np.geomspace(1, self.episodes, self.checkpoints)
        return sorted({*np.rint(spread).astype(int).tolist(), self.episodes})


@dataclass(frozen=True, eq=False)
class Learned:
    """What came of learning.

    `greedy_returns` and `training_returns` are the docstring's two measures at each checkpoint; minus
    infinity where the greedy policy may never end and the discount is 1.
    """

    method: Method
    discount: float
    seed: int
    checkpoints: tuple[int, ...]  # episodes
    greedy_returns: tuple[float, ...]
    training_returns: tuple[float, ...]
    optimum: float
    visited: int  # entries that were updated
    steps: int  # of all episodes
    values: tuple[FloatArray, ...]  # of each table, by entry
    choice: IntArray  # [task, s] the greedy pair

    def episodes_to(self, close: float = CLOSE) -> int | None:
        """The first checkpoint from which on the greedy return stays within `close` of the optimum."""
        least = self.optimum - close * abs(self.optimum)
        found = None
        for episodes, value in zip(self.checkpoints, self.greedy_returns, strict=True):
            if value < least:
                found = None
            elif found is None:
                found = episodes
        return found


def optimal_values(process: SampledProcess) -> FloatArray:
    """V* [s], by the solvers of `factored_polca.solvers`."""
    return solve_mdp(process.mdp).values


def learn(
    method: Method,
    process: SampledProcess,
    schedule: Schedule,
    seed: int,
    *,
    optimal: FloatArray | None = None,
    progress: Callable[[int], None] | None = None,
) -> Learned:
    """Learn, and measure on the way; the same seed gives the same result.

    `optimal` is V* [s] where it is known already; `progress` is called with the episodes done.
    """
    optimal = optimal_values(process) if optimal is None else optimal
    knobs = schedule.knobs(process.mdp.discount)
    generator = np.random.default_rng(seed)
    tables = tuple(table.empty() for table in method.tables)
    count = schedule.episodes
    record = Record(np.zeros(count), np.zeros(count, dtype=np.int64), np.zeros(count, dtype=np.int64))
    graph = method.graph.arrays
    choice = np.full(graph.over.shape, NONE, dtype=np.int64)
    optimum = float(process.initial @ optimal)
    greedy, training, done = [], [], 0
    for point in schedule.points():
        for begin in range(done, point, BATCH):
            end = min(begin + BATCH, point)
            method.episodes(
                process.arrays, method.graph.arrays, tables, knobs, begin, end, record, generator
            )
        lost = record.returns[done:point] - optimal[record.starts[done:point]]
        training.append(optimum + float(lost.mean()))
        method.greedy(graph, tables, choice)
        greedy.append(return_of_greedy(process, method.graph, choice))
        done = point
        if progress is not None:
            progress(done)
    visited = sum(int((table.visits > 0).sum()) for table in tables)
    return Learned(
        method, process.mdp.discount, seed, tuple(schedule.points()), tuple(greedy), tuple(training),
        optimum, visited, int(record.steps.sum()), tuple(table.values[:-1] for table in tables), choice,
    )  # fmt: skip


@kernel
def epsilon_of(knobs: Knobs, episode: int) -> float:
    """The probability of exploring in an episode."""
    return max(0.0, knobs.exploration * (1.0 - episode / knobs.fading))
