"""Taxi's task graphs (`domains/taxi.py`; Taxi2 is its `anywhere`), read off the enumerated model.

Dietterich's (JAIR 13, 2000, Figure 2), with W places where a passenger may wait (4; in Taxi2 all 25 cells):

    Root = {Get, Put}    Get = {Navigate(source), Pickup}    Put = {Navigate(destination), Putdown}
    Navigate(t) = {North, South, East, West} for each of the W targets t

Get is over unless the passenger waits, Put unless he is in the taxi, Navigate(t) when the taxi is at t.
The parameter of Navigate is bound: Get calls it for where the passenger is, Put for where he wants to go.

For options the root chooses among the six primitive actions and the W tasks Navigate(t).  ALisp's graph is
the program

    Root: until the end, choose Get or Put        Navigate(t): until at t, choose a move
    Get: Navigate(source), Pickup, return         Put: Navigate(destination), Putdown, return

where Get can't be chosen once the passenger is aboard: Taxi's 500 states don't tell where he came from.
Navigate stands in it twice, under Get and under Put, for its features ask which of the two called.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.baselines.process import SampledProcess
from factored_polca.baselines.task_graph import NONE, TaskGraph, TaskRow, task_graph
from factored_polca.explicit.arrays import BoolArray, IntArray
from factored_polca.models import ModelError

NEEDED = ("x", "y", "passenger", "destination")


@dataclass(frozen=True, eq=False)
class TaxiFacts:
    """What task graphs and abstractions ask of a Taxi model's states."""

    process: SampledProcess
    places: tuple[str, ...]  # where a passenger can wait, W of them
    place_cells: IntArray  # [place] the cell
    goals: tuple[int, ...]  # the places where passengers may want to go
    cell: IntArray  # [s], the taxi's
    source: IntArray  # [s], the place where the passenger waits, NONE where he doesn't
    goal: IntArray  # [s], the place where he wants to go
    waiting: BoolArray  # [s]
    aboard: BoolArray  # [s]

    @property
    def moves(self) -> tuple[str, ...]:
        """The actions that move the taxi."""
        return tuple(name for name in self.process.actions if name not in ("Pickup", "Putdown"))

    def action(self, name: str) -> int:
        """The number of a primitive action."""
        return self.process.actions.index(name)

    def at(self, place: IntArray | int) -> BoolArray:
        """[s], whether the taxi is at a place; nowhere for NONE."""
        here: BoolArray = self.cell == np.where(np.asarray(place) < 0, -1, self.place_cells[place])
        return here


def taxi_facts(process: SampledProcess) -> TaxiFacts:
    """The facts of a Taxi model.

    Raises:
        ModelError: it is not Taxi.
    """
    names = [feature.name for feature in process.exact.features]
    if not set(NEEDED) <= set(names) or not {"Pickup", "Putdown"} <= set(process.actions):
        raise ModelError(
            "the hand-made task graphs and abstractions are Taxi's: a model with the features "
            f"{', '.join(NEEDED)} and the actions Pickup and Putdown"
        )
    values = process.exact.features
    digits = {
        name: np.array([values[k].index(row[k]) for row in process.exact.state_values])
        for k, name in enumerate(names)
    }
    height = len(values[names.index("y")].values)
    passengers = [str(value) for value in values[names.index("passenger")].values]
    goals = [str(value) for value in values[names.index("destination")].values]
    places = tuple(name for name in passengers if name not in ("taxi", "delivered"))
    cell = digits["x"] * height + digits["y"]
    rank = np.array([places.index(name) if name in places else NONE for name in passengers])
    source = rank[digits["passenger"]]
    waiting = source >= 0
    aboard = np.array([name == "taxi" for name in passengers])[digits["passenger"]]
    return TaxiFacts(
        process, places, _place_cells(process, cell, source, aboard, len(places)),
        tuple(places.index(name) for name in goals), cell, source,
        np.array([places.index(name) for name in goals])[digits["destination"]], waiting, aboard,
    )  # fmt: skip


def _place_cells(
    process: SampledProcess, cell: IntArray, source: IntArray, aboard: BoolArray, places: int
) -> IntArray:
    """[place], the cell where Pickup takes the passenger aboard."""
    after = process.arrays.successors[process.actions.index("Pickup"), :, 0]
    works = (source >= 0) & aboard[after] & process.live
    found = np.full(places, NONE)
    found[source[works]] = cell[works]
    return found


def dietterich_graph(facts: TaxiFacts) -> TaskGraph:
    """Dietterich's graph, with a task for each target."""
    first, terminal = len(facts.process.actions), facts.process.arrays.terminal
    get, put, target = first + 1, first + 2, first + 3
    everywhere = np.ones(len(terminal), dtype=np.int64)
    to_source = np.where(facts.waiting, target + facts.source, NONE)
    rows = [
        TaskRow("Root", (("Get", get * everywhere), ("Put", put * everywhere)), terminal),
        TaskRow(
            "Get",
            (("Navigate", to_source), ("Pickup", facts.action("Pickup") * everywhere)),
            ~facts.waiting,
        ),
        TaskRow(
            "Put",
            (("Navigate", target + facts.goal), ("Putdown", facts.action("Putdown") * everywhere)),
            ~facts.aboard,
        ),
        *_navigation(facts, "Navigate", range(len(facts.places))),
    ]
    return task_graph(rows, terminal, first)


def options_graph(facts: TaxiFacts) -> TaskGraph:
    """A root over all primitive actions and an option for each target."""
    first, terminal = len(facts.process.actions), facts.process.arrays.terminal
    everywhere = np.ones(len(terminal), dtype=np.int64)
    slots = [(name, a * everywhere) for a, name in enumerate(facts.process.actions)]
    slots += [(f"Navigate_{name}", (first + 1 + t) * everywhere) for t, name in enumerate(facts.places)]
    rows = [
        TaskRow("Root", tuple(slots), terminal),
        *_navigation(facts, "Navigate", range(len(facts.places))),
    ]
    return task_graph(rows, terminal, first)


def alisp_graph(facts: TaxiFacts) -> TaskGraph:
    """The program of the docstring; the targets under Put are the places where passengers may go."""
    first, terminal = len(facts.process.actions), facts.process.arrays.terminal
    everywhere, never = np.ones(len(terminal), dtype=np.int64), np.zeros(len(terminal), dtype=np.bool_)
    get, put, target = first + 1, first + 2, first + 3
    under_put = np.full(len(facts.places), NONE)
    under_put[list(facts.goals)] = target + len(facts.places) + np.arange(len(facts.goals))
    rows = [
        TaskRow(
            "Root", (("Get", np.where(facts.waiting, get, NONE)), ("Put", put * everywhere)), terminal
        ),
        TaskRow(
            "Get", (("Navigate", np.where(facts.waiting, target + facts.source, NONE)),), never,
            facts.action("Pickup"),
        ),
        TaskRow("Put", (("Navigate", under_put[facts.goal]),), never, facts.action("Putdown")),
        *_navigation(facts, "Get's Navigate", range(len(facts.places))),
        *_navigation(facts, "Put's Navigate", facts.goals),
    ]  # fmt: skip
    return task_graph(rows, terminal, first)


def _navigation(facts: TaxiFacts, name: str, targets: range | tuple[int, ...]) -> list[TaskRow]:
    everywhere = np.ones(facts.process.states, dtype=np.int64)
    moves = tuple((move, facts.action(move) * everywhere) for move in facts.moves)
    return [TaskRow(f"{name}_{facts.places[t]}", moves, facts.at(t)) for t in targets]
