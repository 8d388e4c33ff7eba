"""Figure 4b again where all numbers of a domain are a little different: how much hangs on them.

A domain with the parameters `perturbation` and `seed` draws its numbers anew for each seed.  For the seeds
1 .. N the policies but SARSOP are planned and run, and it is counted in how many of them

    PolCA+ > PolCA > QMDP

holds for the mean discounted returns, for the mean cumulative rewards at the end, and for the returns by
more than two standard errors of the paired differences.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any, Final

from factored_polca import library
from factored_polca.hierarchy import Options
from factored_polca.models import ModelError
from factored_polca.studies.parameters import Progress, silent
from factored_polca.studies.rewards import ORDER, Difference, difference_data, study_rewards

EPISODES: Final = 300
"""Episodes of each policy for each seed."""

SHARE: Final = Fraction(1, 5)
"""The paper's reconstruction is asked to hold up when numbers change by up to a fifth."""

NEEDED: Final = ("perturbation", "seed")


@dataclass(frozen=True)
class PerturbedRun:
    """What the policies earned for one seed: mean discounted returns and cumulative rewards, by `ORDER`."""

    seed: int
    means: tuple[float, ...]
    standard_errors: tuple[float, ...]
    cumulative: tuple[float, ...]
    differences: tuple[Difference, ...]

    @property
    def order_holds(self) -> bool:
        """Whether the mean returns descend."""
        return all(high > low for high, low in pairwise(self.means))

    @property
    def cumulative_order_holds(self) -> bool:
        """Whether the cumulative rewards descend."""
        return all(high > low for high, low in pairwise(self.cumulative))

    @property
    def order_is_clear(self) -> bool:
        """Whether the returns descend, by more than two standard errors each time."""
        return self.order_holds and all(d.clear for d in self.differences)


@dataclass(frozen=True)
class PerturbationStudy:
    """The runs of all seeds."""

    model: str
    share: Fraction
    episodes: int
    steps: int
    runs: tuple[PerturbedRun, ...]

    @property
    def held(self) -> int:
        """In how many seeds the mean returns have the paper's order."""
        return sum(run.order_holds for run in self.runs)

    @property
    def cumulative_held(self) -> int:
        """In how many the cumulative rewards have it."""
        return sum(run.cumulative_order_holds for run in self.runs)

    @property
    def clear(self) -> int:
        """In how many the returns have it by more than two standard errors."""
        return sum(run.order_is_clear for run in self.runs)

    @property
    def refuted(self) -> int:
        """In how many two policies stand the other way round by more than two standard errors."""
        return sum(any(d.clear and d.mean < 0 for d in run.differences) for run in self.runs)

    def to_data(self) -> dict[str, Any]:
        """The study as plain data."""
        return {
            "figure": "4b",
            "model": self.model,
            "perturbation": float(self.share),
            "episodes": self.episodes,
            "steps": self.steps,
            "perturbations": len(self.runs),
            "order": list(ORDER),
            "held": self.held,
            "cumulative_held": self.cumulative_held,
            "clear": self.clear,
            "refuted": self.refuted,
            "runs": [
                {
                    "seed": run.seed,
                    "means": dict(zip(ORDER, run.means, strict=True)),
                    "standard_errors": dict(zip(ORDER, run.standard_errors, strict=True)),
                    "cumulative_end": dict(zip(ORDER, run.cumulative, strict=True)),
                    "differences": [difference_data(d) for d in run.differences],
                    "order_holds": run.order_holds,
                    "cumulative_order_holds": run.cumulative_order_holds,
                    "order_is_clear": run.order_is_clear,
                }
                for run in self.runs
            ],
        }


def study_perturbations(
    domain: str,
    parameters: Mapping[str, object] | None = None,
    options: Options | None = None,
    *,
    count: int = 30,
    share: Fraction = SHARE,
    episodes: int = EPISODES,
    steps: int | None = None,
    progress: Progress = silent,
) -> PerturbationStudy:
    """Compare PolCA+, PolCA and QMDP on `domain` for the seeds 1 .. `count`.

    Raises:
        ModelError: no such domain, or it can't be perturbed; `parameters` set what is set here.
    """
    refuse_fixed_numbers(domain, parameters or {})
    options = options or Options()
    runs, length = [], 0
    for seed in range(1, count + 1):
        loaded = library.load(domain, {**(parameters or {}), "perturbation": str(share), "seed": str(seed)})
        study = study_rewards(
            loaded.model,
            loaded.tasks,
            replace(options, flat_block_limit=None),
            episodes=episodes,
            steps=steps,
            flat_trials=None,
            progress=lambda text, n=seed: progress(f"{n} of {count}: {text}"),  # type: ignore[misc]
        )
        earned, length = [study.of(name) for name in ORDER], study.steps
        runs.append(
            PerturbedRun(
                seed,
                tuple(one.mean for one in earned),
                tuple(one.standard_error for one in earned),
                tuple(float(one.cumulative[-1]) for one in earned),
                study.differences,
            )
        )
    return PerturbationStudy(domain, share, episodes, length, tuple(runs))


def refuse_fixed_numbers(domain: str, parameters: Mapping[str, object]) -> None:
    """Refuse a domain whose numbers can't be perturbed.

    Raises:
        ModelError: it lacks a parameter for that, or `parameters` sets one.
    """
    known = {parameter.name for parameter in library.describe(domain).parameters}
    if not known >= set(NEEDED):
        able = [
            name
            for name in library.domains()
            if {p.name for p in library.describe(name).parameters} >= set(NEEDED)
        ]
        raise ModelError(
            f"{domain} has no parameters 'perturbation' and 'seed' to draw its numbers with; "
            f"{', '.join(able)} has"
        )
    for name in NEEDED:
        if name in parameters:
            raise ModelError(f"the parameter {name!r} is set for each run here; leave it out")
