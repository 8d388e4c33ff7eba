"""The commands and their options.  A command with many options has a function of its own that adds them."""

from __future__ import annotations

import argparse

from factored_polca import __version__
from factored_polca.cli.approximation_arguments import add_merging
from factored_polca.cli.argument_types import (
    FLAT_TRIALS,
    ORDERS,
    TRIALS,
    counting,
    discount,
    gap,
    horizon,
    natural,
    positive,
    size,
    solver,
)
from factored_polca.cli.bench_arguments import add_bench
from factored_polca.cli.compare_arguments import add_comparing
from factored_polca.cli.sensitivity_arguments import add_keeping, add_sensitivity
from factored_polca.cli.study_arguments import add_study

DESCRIPTION = """Plan factored Markov decision processes, their state seen or not, with task
hierarchies: each subtask is minimised exactly on decision diagrams, without enumerating states, and
solved (PolCA, PolCA+).  Small models are solved flat, state by state."""

EXAMPLES = """examples:
  factored-polca plan taxi --set size=10        plan a shipped domain
  factored-polca minimise linear --set size=64  2^64 states become 65 blocks
  factored-polca new robot                      write robot.toml, a model to start from
  factored-polca plan robot.toml -o robot.polca
  factored-polca simulate robot.polca --episodes 1000
  factored-polca solve tiger -o tiger.policy    a partially observed model
  factored-polca simulate tiger.policy
  factored-polca run nurse.polca                a dialogue, after plan nursebot -o nurse.polca
"""

SOLVE_NOTES = """solvers:
  auto      choose by the model, and say what was done and why
  exact     certified bounds by the best method; with --horizon exact sets of vectors
  witness   the same with --horizon, by another algorithm: a cross-check
  sarsop, hsvi, pbvi, perseus   point-based: a policy, and bounds on the optimum
  qmdp, fib, blind, amdp        quick and coarse; for qmdp, fib and amdp simulate tells what they earn
  symbolic  partially observed models, on diagrams: no state is listed; auto takes it for models with too
            many states to list
  vi, pi, mpi                   fully observed models: value, policy, modified policy iteration
  structured                    fully observed models, without listing states: value iteration on diagrams
  package.module:Name           any solver that can be called as factored_polca.solvers.protocol says;
                                the module is imported, so name only what you trust

--gap and --epsilon are one thing: upper - lower at the start.  Without them 0.001, for exact 1e-6; fully
observed models are solved to 1e-9 of the largest value.  There is no time limit but --time; listing
the states may take as long, and then solving.  Only states that the start can reach are listed.  Where
these are too many, auto solves a fully observed model over the blocks of its quotient, and where those
are too many on diagrams.

exit status: 0 with a result, also where --time or --iterations stopped the solver; 130 after Ctrl-C, with
the result so far printed and written if there is one; 3 where memory or another limit was reached.
"""


RUN_NOTES = """at each step type what was observed, for example
  Speech=yes          a channel, or a feature that is seen, and its value
  yes                 the same, where one of them has that value
  (an empty line)     nothing, or none from every channel
  ?                   what may be observed, with probabilities
  back                take the last step back
  ended               the episode has ended
  quit                leave; the end of the input does the same

Lines may come from a pipe.  With --json the dialogue is on stderr, and one object on stdout at the end.
"""


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    top = argparse.ArgumentParser(
        "factored-polca",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"factored-polca {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
        sub.add_argument("-q", "--quiet", action="store_true", help="no progress, no notes")
        return sub

    def with_model(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("model", metavar="MODEL", help="a model file, or the name of a shipped domain")
        sub.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="set a parameter; may be repeated",
        )

    def with_memory(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--memory", type=size, metavar="SIZE", help="memory limit, such as 2GB")

    def with_limits(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--seed", type=natural, default=0, metavar="S", help="seed of random draws (0)")
        with_memory(sub)
        sub.add_argument("--time", type=positive, metavar="SECONDS", help="time limit")
        sub.add_argument("--order", default="auto", choices=ORDERS, help="order of the diagrams' variables")
        sub.add_argument("--reachable", action="store_true", help="only states that the start can reach")

    command("domains", "List the shipped domains.")
    command("new", "Write a commented model to start from.").add_argument("name", metavar="NAME")
    with_model(command("info", "Describe a model, or a domain and its parameters."))
    sub = command("check", "Check a model and its tasks, and report all faults at once.")
    with_model(sub)
    with_memory(sub)
    sub.add_argument("--time", type=positive, metavar="SECONDS", help="time limit of compiling the model")
    sub = command("minimise", "Merge the states that behave alike, exactly.")
    with_model(sub)
    with_limits(sub)
    sub.add_argument("--actions", metavar="A,B,...", help="only these actions count")
    sub.add_argument("--certify", action="store_true", help="check the partition without fingerprints")
    add_keeping(sub)
    sub.add_argument(
        "--interchangeable", action="store_true",
        help="actions count by what they do, not by name (where the state is seen)",
    )  # fmt: skip
    add_merging(sub, "planning on the blocks")
    sub = command("plan", "Plan a task hierarchy: PolCA, or PolCA+ where the state is not seen.")
    with_model(sub)
    with_limits(sub)
    sub.add_argument("--tasks", metavar="FILE", help="take the tasks from this .toml file")
    sub.add_argument("-o", "--output", metavar="PLAN", help="write the plan to a file")
    sub.add_argument(
        "--store", default="blocks", choices=("blocks", "q", "value", "action"),
        help="write policies over states of equal Q-values, of equal value and action, or of equal action, "
        "not over blocks (where the state is seen)",
    )  # fmt: skip
    sub.add_argument(
        "--discount", type=discount, metavar="D",
        help="plan without end, with this discount: in place of the model's discount and horizon",
    )  # fmt: skip
    sub.add_argument(
        "--solver", default="auto", type=solver, metavar="NAME",
        help="for tasks that name none: vi, pi, mpi, structured where the state is seen, else any that "
        "solve has, symbolic (without a quotient) among them; or package.module:Name, which is imported",
    )  # fmt: skip
    sub.add_argument("--no-flat", action="store_true", help="leave out the flat optimum")
    sub.add_argument(
        "--flat-blocks", type=natural, default=100_000, metavar="N",
        help="leave out the flat optimum beyond N blocks (100000)",
    )  # fmt: skip
    sub.add_argument(
        "--interchangeable", action="store_true",
        help="actions count by what they do, not by name (where the state is seen)",
    )  # fmt: skip
    add_merging(sub, "each task, given its children's policies,")
    group = sub.add_argument_group("where the state is not seen")
    group.add_argument(
        "--gap", type=gap, metavar="G",
        help="solve tasks to upper - lower <= G (a thousandth of the span of their rewards)",
    )  # fmt: skip
    group.add_argument(
        "--trials",
        type=counting,
        default=TRIALS,
        metavar="N",
        help=f"no more than N trials a task ({TRIALS})",
    )
    group.add_argument(
        "--episodes", type=counting, metavar="N",
        help="that measure each task with children (1000 the root, 250 others; 100 without blocks)",
    )  # fmt: skip
    group.add_argument("--polca", action="store_true", help="plan as if the state were seen: PolCA")
    sub = command("solve", "Solve a model as it is, partially observed or not, without a hierarchy.")
    with_model(sub)
    with_memory(sub)
    add_solving(sub)
    sub = command("act", "Say what a plan does in a state, or at a belief, and why.")
    sub.add_argument("plan", metavar="PLAN")
    sub.add_argument("--state", metavar="x=3,y=2,...", help="a value for each feature")
    sub.add_argument("--belief", metavar="SPEC", help=BELIEF)
    sub = command("run", "Run a plan step by step where the state is not seen: you say what is observed.")
    sub.epilog, sub.formatter_class = RUN_NOTES, argparse.RawDescriptionHelpFormatter
    sub.add_argument("plan", metavar="PLAN")
    sub.add_argument("--belief", metavar="SPEC", help=BELIEF)
    sub.add_argument(
        "--steps", type=counting, metavar="N", help="no more than N steps; with --auto 20 if not given"
    )
    sub.add_argument("--auto", action="store_true", help="observations are drawn from the model, unseen")
    sub.add_argument("--seed", type=natural, metavar="S", help="seed of what --auto draws (0)")
    sub = command("simulate", "Run a plan, or a policy that solve found, on the original model.")
    sub.add_argument("plan", metavar="FILE", help="a plan or a policy")
    sub.add_argument(
        "--episodes",
        type=counting,
        metavar="N",
        help="1000 if not given; 100 where beliefs are not over blocks",
    )
    sub.add_argument(
        "--steps", type=counting, metavar="T", help="steps an episode; by the discount if not given"
    )
    sub.add_argument("--seed", type=natural, default=0, metavar="S")
    add_comparing(
        command("compare", "Compare two plans, or policies, of one model on the same random numbers.")
    )
    add_bench(command("bench", "Time minimisation on shipped domains, beside Storm where it is installed."))
    add_figures(command("figure", "The figures of the paper, from our own runs: 4a, 4b, 4c, table1."))
    add_study(
        command("study", "Grids of runs with hard limits that survive being stopped; tables and plots.")
    )
    sub = command("sensitivity", "The optimal value as a function of parameters, from one minimisation.")
    with_model(sub)
    with_limits(sub)
    add_sensitivity(sub)
    sub = command("convert", "Write a model in another format, chosen by the extension.")
    with_model(sub)
    with_memory(sub)
    sub.add_argument(
        "--time", type=positive, metavar="SECONDS", help="time limit of compiling and minimising the model"
    )
    sub.add_argument("output", metavar="OUT")
    sub.add_argument("--no-tasks", action="store_true", help="leave the tasks out")
    sub.add_argument("--minimise", action="store_true", help="write the quotient: a state for each block")
    sub.add_argument(
        "--first-step",
        action="store_true",
        help="begin a .pomdp file with a step that shows what is seen at first (values times the discount)",
    )
    return top


def add_solving(sub: argparse.ArgumentParser) -> None:
    """The options of `solve` beside the model's."""
    sub.epilog, sub.formatter_class = SOLVE_NOTES, argparse.RawDescriptionHelpFormatter
    sub.add_argument("--solver", default="auto", type=solver, metavar="NAME", help="see below")
    sub.add_argument("--gap", type=gap, metavar="G", help="stop at upper - lower <= G at the start")
    sub.add_argument("--epsilon", type=gap, metavar="E", help="the same as --gap")
    sub.add_argument("--time", type=positive, metavar="SECONDS", help="solve no longer than that")
    sub.add_argument("--iterations", type=counting, metavar="N", help="no more than N of the solver's")
    sub.add_argument(
        "--horizon", type=horizon, metavar="H", help="steps, or infinite; the model's if not given"
    )
    sub.add_argument(
        "--discount", type=discount, metavar="D", help="such as 0.95 or 19/20; the model's if not given"
    )
    sub.add_argument("--seed", type=natural, default=0, metavar="S", help="seed of random draws (0)")
    sub.add_argument("-o", "--output", metavar="POLICY", help="write the policy to a file")


BELIEF = (
    "where the state is not seen: features, independent, with their probabilities, such as "
    "battery=low,person=room:0.9/physio:1/10; others as at the start, as all are if it is not given"
)


def add_figures(sub: argparse.ArgumentParser) -> None:
    """The figures, each with its options."""
    figures = sub.add_subparsers(dest="which", required=True, metavar="FIGURE")

    def one(name: str, text: str) -> argparse.ArgumentParser:
        found = figures.add_parser(name, help=text, description=text)
        # Without a default they leave what stands before the figure's name as it is.
        found.add_argument(
            "--json", action="store_true", default=argparse.SUPPRESS, help="print one JSON object only"
        )
        found.add_argument(
            "-q", "--quiet", action="store_true", default=argparse.SUPPRESS, help="no progress, no notes"
        )
        found.add_argument(
            "--set", action="append", default=[], metavar="NAME=VALUE", help="set a parameter of the model"
        )
        found.add_argument("--seed", type=natural, default=0, metavar="S", help="seed of random draws (0)")
        return found

    def with_trials(found: argparse.ArgumentParser) -> None:
        found.add_argument(
            "--trials",
            type=counting,
            default=TRIALS,
            metavar="N",
            help=f"trials a task of PolCA+ ({TRIALS})",
        )

    def with_picture(found: argparse.ArgumentParser) -> None:
        found.add_argument(
            "model", metavar="MODEL", nargs="?", default="nursebot", help="nursebot if not given"
        )
        with_trials(found)
        with_output(found)

    def with_output(found: argparse.ArgumentParser) -> None:
        found.add_argument("-o", "--output", metavar="FILE.png", help="draw it (needs matplotlib)")

    def with_flat_trials(found: argparse.ArgumentParser) -> None:
        found.add_argument(
            "--flat-trials", type=counting, default=FLAT_TRIALS, metavar="N",
            help=f"trials of SARSOP without a hierarchy ({FLAT_TRIALS})",
        )  # fmt: skip

    with_picture(one("4a", "Parameters of the tasks' models: without abstraction, by PolCA, by PolCA+."))
    found = one("4b", "What PolCA+, PolCA, QMDP and flat SARSOP earn, over time.")
    with_picture(found)
    with_flat_trials(found)
    found.add_argument("--episodes", type=counting, metavar="N", help="1000; with --perturbations 300")
    found.add_argument(
        "--steps", type=counting, metavar="T", help="steps an episode; by the discount if not given"
    )
    found.add_argument(
        "--perturbations", type=counting, metavar="N",
        help="compare on N models with randomly changed numbers, without SARSOP",
    )  # fmt: skip
    found.add_argument(
        "--perturbation", type=discount, metavar="Q", help="by up to which share they are changed (0.2)"
    )
    found = one("4c", "What PolCA and learners store for Taxi and Taxi2, and how fast these learn.")
    found.add_argument(
        "--episodes", type=counting, metavar="N", help="of each learner; 100 for each state if not given"
    )
    with_output(found)
    found = one("table1", "What the controller does in the dialogue of the paper's Table 1.")
    with_trials(found)
    with_flat_trials(found)
