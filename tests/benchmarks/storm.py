"""Time our minimiser and Storm's on the same models in one run: `python tests/benchmarks/storm.py`.

Needs the extra `storm`.  Each measurement runs in a process of its own, on one core: processor seconds
of building the model and of minimising it, and the peak memory of the process, everything included.  Storm
reads the PRISM program that `factored_polca.formats.prism_writer` makes of the model; we start from the
model, kernels loaded.  So that no peer loses lumps to rounding, probabilities are rounded to dyadic ones
for both, so coarse that products over all features are exact in doubles: their odd parts stay below 2^53.

    ours     named actions; `interchangeable` where the case says so
    sparse   Storm's sparse engine: explores reachable states, action-sensitive bisimulation, in doubles
    dd       Storm's dd engine (Sylvan, one worker): bisimulation that does not tell actions by name

A run that needs more than the limits is shown as its limit.  Blocks differ where engines look at different
states: ours counts all, Storm's reachable ones.

    python tests/benchmarks/storm.py [--case NUMBER ...] [--seconds 300] [--gigabytes 12]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))


@dataclass(frozen=True)
class Case:
    """A model and the engines that are worth trying on it."""

    title: str
    domain: str
    settings: dict[str, str]
    interchangeable: bool = False
    engines: tuple[str, ...] = ("sparse", "dd")
    denominator: int = 0  # of probabilities; 0: the least power of two that gives each outcome a share


CASES = (
    Case("linear, 48 bits", "linear", {"size": "48"}, engines=("dd",), denominator=256),
    Case("Taxi 5x5, 8 irrelevant bits", "taxi", {"noise_bits": "8"}, engines=("dd",), denominator=4),
    Case("ring of 10 machines", "sysadmin", {"size": "10"}, engines=("sparse",), denominator=32),
    Case("ring of 10 machines", "sysadmin", {"size": "10"}, True, ("dd",), denominator=32),
    Case("Taxi 64x64", "taxi", {"size": "64"}, engines=("sparse",)),
    Case("expon, 14 bits", "expon", {"size": "14"}, denominator=256),
    Case(
        "30 machines", "sysadmin", {"size": "30", "topology": "independent"}, True, ("dd",), denominator=4
    ),
    Case("components, 40 parts", "components", {"size": "40"}, engines=("dd",)),
)
"""Storm's other engine is left out where it takes minutes, or does other work: dd names no actions."""


def dyadic(model: Any, denominator: int) -> Any:
    """The model with constant probabilities rounded to fractions of `denominator`, none of them to 0."""
    from factored_polca.models.expressions import Constant, Expression, Lottery
    from factored_polca.models.model import Action, replace_fields

    def rounded(e: Expression) -> Expression:
        if isinstance(e, Lottery):
            chances = [q.value for _, q in e.outcomes if isinstance(q, Constant)]
            if len(chances) < len(e.outcomes):
                raise ValueError("a probability that is no constant")
            if len(chances) == 1:
                return e
            whole = denominator or 1 << (len(chances) - 1).bit_length()
            parts = [max(1, round(Fraction(q) * whole)) for q in chances]  # type: ignore[arg-type]
            parts[parts.index(max(parts))] += whole - sum(parts)
            return Lottery(
                tuple(
                    (value, Constant(Fraction(k, whole)))
                    for (value, _), k in zip(e.outcomes, parts, strict=True)
                )
            )
        return e

    def walk(e: Expression) -> Expression:
        from factored_polca.models.expressions import Conditional, Switch

        if isinstance(e, Conditional):
            return Conditional(e.condition, walk(e.then), walk(e.otherwise))
        if isinstance(e, Switch):
            otherwise = None if e.otherwise is None else walk(e.otherwise)
            return Switch(e.reference, tuple((v, walk(case)) for v, case in e.cases), otherwise)
        return rounded(e)

    actions = tuple(
        Action(
            a.name, [(name, walk(e)) for name, e in a.effects], applicable=a.applicable, rewards=a.rewards
        )
        for a in model.actions
    )
    return replace_fields(model, actions=actions)


def begun(model: Any) -> Any:
    """The model from one state, where an action `begin` draws what the initial belief leaves open.

    Storm lists the states of an `init` with an SMT solver, one by one, which would take most of its time;
    so its sparse engine gets this model, one state larger; its dd engine and we get the original.
    """
    from factored_polca.models import FALSE, TRUE, Action, boolean, conjunction, lottery, operation
    from factored_polca.models.expressions import Constant, Lottery
    from factored_polca.models.model import InitialBelief, replace_fields
    from factored_polca.models.scalars import scalar

    first, drawn = dict(model.initial.distributions), {}
    for feature in model.features:
        values = [Constant(scalar(value)) for value in feature.values]
        given = first.get(feature.name, lottery([(v, Fraction(1, len(values))) for v in values]))
        if isinstance(given, Lottery) and len(given.outcomes) > 1:
            drawn[feature.name] = given
            given = given.outcomes[0][0]
        first[feature.name] = given
    if not drawn:
        return replace_fields(model, initial=InitialBelief(first))
    started = boolean("started")
    actions = [
        Action(a.name, a.effects, applicable=conjunction([started.now, a.applicable]), rewards=a.rewards)
        for a in model.actions
    ]
    begin = Action("begin", {**drawn, started: TRUE}, applicable=operation("not", started.now))
    return replace_fields(
        model, features=(*model.features, started), actions=(begin, *actions),
        initial=InitialBelief({**first, started.name: FALSE}),
    )  # fmt: skip


def model_of(case: Case, *, from_one_state: bool) -> Any:
    """The model of a case."""
    from factored_polca import library

    model = library.load(case.domain, case.settings).model
    return dyadic(begun(model) if from_one_state else model, case.denominator)


def run_ours(case: Case) -> dict[str, Any]:
    """Minimise with our minimiser in this process."""
    from factored_polca.hierarchy.warm import warm_up
    from factored_polca.minimisation import flat_process, minimise
    from factored_polca.symbolic import compile_model

    model = model_of(case, from_one_state=False)
    warm_up()
    began = time.process_time()
    symbolic = compile_model(model)
    built = time.process_time()
    result = minimise(flat_process(symbolic), interchangeable=case.interchangeable)
    ended = time.process_time()
    return {
        "states": f"{model.states:.3g}", "blocks": result.partition.blocks, "build": built - began,
        "minimise": ended - built,
    }  # fmt: skip


def run_storm(path: str, engine: str) -> dict[str, Any]:
    """Minimise with an engine of Storm's in this process."""
    import stormpy

    began = time.process_time()
    program = stormpy.parse_prism_program(path)
    properties = stormpy.parse_properties('R{"reward"}max=? [ C ]', program)
    if engine == "dd":
        model = stormpy.build_symbolic_model[float](program, properties)
        built = time.process_time()
        quotient = stormpy.transformations.perform_bisimulation(model, properties)
    else:
        options = stormpy.BuilderOptions()
        options.set_build_all_reward_models()
        options.set_build_choice_labels()
        model = stormpy.build_model[float](program, options=options)
        built = time.process_time()
        wanted = stormpy.transformations.BisimulationOptions()
        wanted.action_sensitive = True
        wanted.preserve_all_rewards = True
        wanted.state_label_preservation = stormpy.transformations.StateLabelPreservation.NONE
        quotient = stormpy.transformations.perform_bisimulation(model, [], options=wanted)
    ended = time.process_time()
    return {
        "states": f"{model.nr_states:.3g}", "blocks": quotient.nr_states, "build": built - began,
        "minimise": ended - built,
    }  # fmt: skip


def measured(arguments: list[str], limits: argparse.Namespace) -> dict[str, Any]:
    """What a run of this file in a fresh process gives, or the limit that it met."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (limits.seconds, limits.seconds))
        size = int(limits.gigabytes * 2**30)
        resource.setrlimit(resource.RLIMIT_AS, (size, size))

    environment = {**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, __file__, *arguments], capture_output=True, env=environment, preexec_fn=limit,
        text=True, check=False,
    )  # fmt: skip
    if done.returncode == 0:
        return dict(json.loads(done.stdout.splitlines()[-1]))
    said = done.stderr.strip().splitlines()
    if done.returncode in (-9, -24):
        return {"failed": f"more than {limits.seconds} s"}
    memory = any("alloc" in line or "memory" in line.lower() for line in said)
    return {
        "failed": f"more than {limits.gigabytes:g} GB" if memory else (said[-1][:80] if said else "failed")
    }


def table(limits: argparse.Namespace) -> None:
    """Run the cases and print one table."""
    import stormpy

    print(
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {platform.machine()}, "
        f"Python {platform.python_version()}, stormpy {stormpy.__version__}; processor seconds, one core; "
        f"load {os.getloadavg()[0]:.1f}"
    )
    print(
        "case | engine | states | blocks | build s | minimise s | peak MiB | seconds / ours | memory / ours"
    )
    chosen = range(len(CASES)) if limits.case is None else limits.case
    for number in chosen:
        case = CASES[number]
        with tempfile.TemporaryDirectory() as folder:
            ours = measured(["--ours", str(number)], limits)
            show(case, "ours, interchangeable" if case.interchangeable else "ours", ours, ours)
            for engine in case.engines:
                path = Path(folder) / f"{engine}.prism"
                command = [sys.executable, __file__, "--write", str(number), str(path), engine]
                subprocess.run(command, check=True)
                show(case, engine, measured(["--storm", str(path), engine], limits), ours)


def show(case: Case, engine: str, row: dict[str, Any], ours: dict[str, Any]) -> None:
    """Print a row."""
    if "failed" in row:
        print(f"{case.title} | {engine} | {row['failed']}", flush=True)
        return
    seconds = row["build"] + row["minimise"]
    ratios = ""
    if row is not ours and "failed" not in ours:
        ratios = (
            f"{seconds / (ours['build'] + ours['minimise']):.2f} | {row['memory'] / ours['memory']:.2f}"
        )
    print(
        f"{case.title} | {engine} | {row['states']} | {row['blocks']:,} | {row['build']:.2f} | "
        f"{row['minimise']:.2f} | {row['memory']:,} | {ratios}",
        flush=True,
    )


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--case", type=int, nargs="+")
    parser.add_argument("--seconds", type=int, default=300)
    parser.add_argument("--gigabytes", type=float, default=12)
    parser.add_argument("--ours", type=int)
    parser.add_argument("--storm", nargs=2)
    parser.add_argument("--write", nargs=3)
    arguments = parser.parse_args()
    if arguments.write:
        from factored_polca.formats.prism_writer import write_prism

        number, path, engine = arguments.write
        model = model_of(CASES[int(number)], from_one_state=engine == "sparse")
        Path(path).write_text(write_prism(model), encoding="utf-8")
        return
    if arguments.ours is None and not arguments.storm:
        table(arguments)
        return
    row = run_ours(CASES[arguments.ours]) if arguments.ours is not None else run_storm(*arguments.storm)
    row["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    print(json.dumps(row))


if __name__ == "__main__":
    main()
