"""Figure 4c: how many values each method stores for Taxi and Taxi2, and how fast the learners get there.

    stored values     learners: the allocated entries of all their tables, over states that are not terminal
                      PolCA: blocks times actions; the classes of (block, action) pairs of each action;
                      the classes shared by the actions of a task; each summed over the tasks
                      (`factored_polca.hierarchy.counts`)
    visited           the entries that learning updated
    return            expected discounted return from the start, exact

The learners run at discount 1, where the abstractions made by hand are exact; PolCA is planned at 1 and at
0.95, for its abstraction does not depend on that.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final

from factored_polca import library
from factored_polca.baselines import (
    Learned,
    SampledProcess,
    Schedule,
    learn,
    sampled_process,
    taxi_facts,
    taxi_methods,
)
from factored_polca.baselines.learning import CLOSE, optimal_values
from factored_polca.baselines.process import MAXIMUM_STATES
from factored_polca.drawn import Framed
from factored_polca.hierarchy import Options, plan_mdp
from factored_polca.hierarchy.counts import QValueCounts, total_counts
from factored_polca.models import LimitReached, ModelError
from factored_polca.studies.parameters import Progress, silent

DISCOUNTS: Final = (Fraction(1), Fraction(95, 100))
"""The discounts that PolCA is planned with."""

EPISODES_PER_STATE: Final = 100
"""Episodes for each state that is not terminal, where nobody says how many."""

VARIANTS: Final = (("Taxi", False), ("Taxi2", True))
"""Titles, and whether the passenger may wait anywhere."""

COUNTS: Final = (
    ("q_values", "blocks × actions"),
    ("q_classes", "classes per action"),
    ("q_classes_shared", "classes shared"),
)
"""PolCA's counts that are shown, and what they are called."""


@dataclass(frozen=True)
class PolcaCounts:
    """What PolCA stores at one discount, what its polled policy earns, and the optimum."""

    discount: Fraction
    counts: QValueCounts
    value: float
    optimum: float


@dataclass(frozen=True)
class TaxiStudy:
    """One of the two domains."""

    title: str
    live_states: int
    episodes: int
    optimum: float  # at discount 1
    learned: tuple[Learned, ...]
    polca: tuple[PolcaCounts, ...]

    def to_data(self) -> dict[str, Any]:
        """The study as plain data."""
        return {
            "domain": self.title,
            "live_states": self.live_states,
            "episodes": self.episodes,
            "optimum": self.optimum,
            "learners": [
                {
                    "name": one.method.name,
                    "discount": one.discount,
                    "stored_values": one.method.stored_values,
                    "visited": one.visited,
                    "tables": {table.name: table.size for table in one.method.tables},
                    "episodes_to_optimum": one.episodes_to(CLOSE),
                    "final_return": one.greedy_returns[-1],
                    "steps": one.steps,
                    "checkpoints": list(one.checkpoints),
                    "greedy_returns": list(one.greedy_returns),
                    "training_returns": list(one.training_returns),
                }
                for one in self.learned
            ],
            "polca": [
                {
                    "discount": float(one.discount),
                    "q_values": one.counts.q_values,
                    "q_applicable": one.counts.q_applicable,
                    "q_classes": one.counts.q_classes,
                    "q_classes_shared": one.counts.q_classes_shared,
                    "return": one.value,
                    "optimum": one.optimum,
                }
                for one in self.polca
            ],
        }


@dataclass(frozen=True)
class QValueStudy(Framed):
    """Both domains."""

    settings: tuple[tuple[str, object], ...]
    seed: int
    close: float
    domains: tuple[TaxiStudy, ...]
    seconds: float

    def to_data(self) -> dict[str, Any]:
        """The study as plain data."""
        return {
            "figure": "4c",
            "settings": {name: str(value) for name, value in self.settings},
            "seed": self.seed,
            "close": self.close,
            "domains": [one.to_data() for one in self.domains],
            "seconds": self.seconds,
        }


def study_q_values(
    settings: Mapping[str, object] | None = None,
    *,
    episodes: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> QValueStudy:
    """Count, learn and plan on Taxi and Taxi2; `settings` are parameters of the domain `taxi`.

    Raises:
        ModelError: a setting that is not right, or one of the two that the figure chooses itself.
        LimitReached: too many states to list.
    """
    began = time.perf_counter()
    settings = dict(settings or {})
    refuse_settings(settings)
    variants = [(title, {**settings, "anywhere": anywhere}) for title, anywhere in VARIANTS]
    processes = []  # of both before the work on one: what is too large is refused at once
    for title, chosen in variants:
        progress(f"{title}: listing the states")
        model = library.load("taxi", {**chosen, "discount": Fraction(1)}).model
        if model.states > MAXIMUM_STATES:
            raise LimitReached(
                f"{title} has {model.states:,} states; learners' tables are made for at most "
                f"{MAXIMUM_STATES:,}: give a smaller size"
            )
        processes.append(sampled_process(model))
    domains = tuple(
        _study(title, process, chosen, episodes, seed, progress)
        for (title, chosen), process in zip(variants, processes, strict=True)
    )
    return QValueStudy(tuple(settings.items()), seed, CLOSE, domains, time.perf_counter() - began)


def refuse_settings(settings: Mapping[str, object]) -> None:
    """Refuse the parameters that the figure chooses itself.

    Raises:
        ModelError: one of them is set.
    """
    for name, why in (("anywhere", "shows both values"), ("discount", "chooses it for each method")):
        if name in settings:
            raise ModelError(f"the parameter {name} can't be set: Figure 4c {why}")


def _study(
    title: str,
    process: SampledProcess,
    settings: dict[str, object],
    episodes: int | None,
    seed: int,
    progress: Progress,
) -> TaxiStudy:
    optimal, live = optimal_values(process), int(process.live.sum())
    schedule = Schedule(episodes=episodes or EPISODES_PER_STATE * live)
    learned = []
    for method in taxi_methods(taxi_facts(process)):

        def tell(done: int, name: str = method.name) -> None:
            progress(f"{title}: {name}, {done:,} of {schedule.episodes:,} episodes")

        tell(0)
        learned.append(learn(method, process, schedule, seed, optimal=optimal, progress=tell))
    polca = []
    for discount in DISCOUNTS:
        progress(f"{title}: PolCA at discount {float(discount):g}")
        polca.append(_polca(settings, discount, seed))
    return TaxiStudy(
        title, live, schedule.episodes, float(process.initial @ optimal), tuple(learned), tuple(polca)
    )


def _polca(settings: dict[str, object], discount: Fraction, seed: int) -> PolcaCounts:
    domain = library.load("taxi", {**settings, "discount": discount})
    found = plan_mdp(domain.model, domain.tasks, Options(seed=seed))
    if found.flat is None:
        raise ModelError(f"{domain.model.name}: the flat optimum is missing: {found.flat_note}")
    return PolcaCounts(discount, total_counts(found.solved), found.polled.value, found.flat.value)
