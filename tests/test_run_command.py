"""The commands act, run and simulate on plans of partially observed models."""

from __future__ import annotations

import io
import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from belief_plans import planned
from test_belief_controller import always

from factored_polca.cli import main
from factored_polca.control import ChosenTracker, DiagramTracker, ParticleTracker
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.executable import executable
from factored_polca.hierarchy.plan_file import save_plan
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.hierarchy.pomdp_plan_file import save_pomdp_plan
from factored_polca.models import (
    Action,
    Feature,
    Model,
    Observation,
    conditional,
    flat_task,
    lottery,
    uniform,
)

Say = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def plans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with NAME.polca for some names, and NAME-seen.polca: planned as if the state were seen."""
    folder = tmp_path_factory.mktemp("plans")
    for name in ("tiger", "meds", "cheese_taxi", "corridor", "finish"):
        plan = planned(name)
        save_pomdp_plan(plan, folder / f"{name}.polca")
    for name in ("meds", "finish"):
        plan = planned(name)
        seen = plan_mdp(plan.model, plan.tasks, Options(assume_observed=True, flat_block_limit=None))
        save_plan(executable(seen, {"value": 2.5}), folder / f"{name}-seen.polca")
    assert main(["plan", "toy", "-o", str(folder / "toy.polca"), "-q", "--json"]) == 0
    return folder


@pytest.fixture(autouse=True)
def folder(plans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of its own with the plans, which is the current one."""
    for path in plans.iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)
    return tmp_path


@pytest.fixture
def say(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Say:
    """Run a command with lines to read; answer its status, stdout and stderr."""

    def run(*arguments: str, lines: str = "") -> tuple[int, str, str]:
        capsys.readouterr()
        monkeypatch.setattr(sys, "stdin", io.StringIO(lines))
        status = main(list(arguments))
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert "a fault of factored-polca" not in captured.err
        return status, captured.out, captured.err

    return run


def done(result: tuple[int, str, str]) -> str:
    assert result[0] == 0, result[2]
    return result[1]


def parsed(result: tuple[int, str, str]) -> Any:
    out = done(result)
    assert out.count("\n") == 1
    return json.loads(out)


# -- act -------------------------------------------------------------------------------------------


def test_act_at_the_start_and_at_a_belief(say: Say) -> None:
    """Listening moves tiger's belief to 0.85 and 0.97; only the second is enough to open a door."""
    assert parsed(say("act", "tiger.polca", "--json"))["action"] == "listen"
    data = parsed(say("act", "tiger.polca", "--belief", "tiger=left:0.85/right:3/20", "--json"))
    assert data["action"] == "listen"
    assert [list(poll) for poll in data["path"]] == [
        ["task", "block", "block_states", "state", "probability", "action", "ended", "looked_ahead"]
    ]
    assert data["path"][0]["state"] == {"tiger": "left"}
    assert data["path"][0]["probability"] == pytest.approx(0.85)
    sure = parsed(say("act", "tiger.polca", "--belief", "tiger=right", "--json"))
    assert sure["action"] == "open_left"
    assert parsed(say("act", "tiger.polca", "--state", "tiger=right", "--json")) == sure


def test_act_prints_the_path_for_people(say: Say) -> None:
    out = done(say("act", "cheese_taxi.polca", "--belief", "destination=s0:1/2/s4:1/2,taxi=s4"))
    assert "Root" in out
    assert "destination=s0" in out
    assert "0.5" in out
    assert "action: " in out


def test_act_says_what_is_special(say: Say) -> None:
    save_pomdp_plan(always(planned("corridor"), "Light"), "forced.polca")
    out = done(say("act", "forced.polca", "--belief", "lamp=true"))
    assert "by looking ahead" in out
    save_pomdp_plan(always(planned("corridor", only_children=True), "Go"), "children.polca")
    assert "this task has ended" in done(say("act", "children.polca", "--state", "lamp=true,place=2"))


def test_act_on_a_plan_made_as_if_the_state_were_seen(say: Say) -> None:
    data = parsed(say("act", "meds-seen.polca", "--belief", "wish=meds:0.2/kitchen:0.8", "--json"))
    assert data["action"] == "GoToKitchen"
    assert data["likeliest_state"] == {"wish": "kitchen"}
    assert [poll["task"] for poll in data["path"]] == ["Act", "Move"]
    out = done(say("act", "meds-seen.polca", "--belief", "wish=meds:0.2/kitchen:0.8"))
    assert "likeliest state: wish=kitchen" in out
    assert "action: CheckMeds" in done(say("act", "meds-seen.polca", "--state", "wish=meds"))
    assert "likeliest state: wish=meds" in done(say("act", "meds-seen.polca"))  # of equal ones the first


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("toy.polca", "--belief", "door=passed"), ["the state is seen", "--state"]),
        (("toy.polca",), ["the state is seen", "--state"]),
        (("tiger.polca", "--belief", "tiger=left", "--state", "tiger=left"), ["--state and --belief"]),
        (("tiger.polca", "--belief", "lion=left"), ["lion", "tiger"]),
        (("tiger.polca", "--belief", "tiger=up"), ["'up'", "left, right"]),
        (("tiger.polca", "--belief", "tiger=left:0.5/right:0.4"), ["9/10", "sum", "1/3"]),
        (("tiger.polca", "--belief", "tiger=left:0.5/left:0.5"), ["left", "twice"]),
        (("tiger.polca", "--belief", "tiger=left,tiger=right"), ["tiger", "twice"]),
        (("tiger.polca", "--belief", "tiger=left:half/right:half"), ["'half'", "no probability", "1/4"]),
        (("tiger.polca", "--belief", "tiger=left:1/0/right:0"), ["'1/0'", "no probability"]),
        (("tiger.polca", "--belief", "tiger=left:-1/right:2"), ["'-1'", "no probability"]),
        (("tiger.polca", "--belief", "tiger=left:1e3"), ["'1e3'", "no probability"]),
        (("tiger.polca", "--belief", "left"), ["FEATURE=VALUE", "'left'"]),
        (("tiger.polca", "--belief", ""), ["FEATURE=VALUE"]),
        (("tiger.polca", "--belief", 'tiger="left'), ["quote"]),
        (("tiger.polca", "--state", "tiger=up"), ["'up'"]),
        (("finish.polca",), ["must be certain", "place=..."]),
        (("finish.polca", "--belief", "place=0:1/2/1:1/2"), ["must be certain", "place=..."]),
        (("finish.polca", "--belief", "place=2,lamp=true"), ["at the start", "impossible"]),
        (("finish.polca", "--state", "place=2,lamp=true"), ["at the start", "impossible"]),
        (("none.polca", "--belief", "x=1"), ["none.polca", "no such file"]),
    ],
)
def test_act_wrongly_used_is_one_error(say: Say, arguments: tuple[str, ...], said: list[str]) -> None:
    status, out, err = say("act", *arguments)
    assert (status, out) == (2, "")
    assert err.count("error: ") == 1
    for part in said:
        assert part in err


# -- run -------------------------------------------------------------------------------------------


def test_a_dialogue_from_a_pipe(say: Say) -> None:
    out = done(say("run", "tiger.polca", lines="growl=left\nleft\nright\n"))
    lines = out.splitlines()
    assert lines[0] == "tiger, 2 states; beliefs tracked: blocks"
    assert "1. listen   flat" in lines
    assert "    tiger  left 0.5  right 0.5" in lines
    assert "growl (left, right)> growl=left" in lines
    assert "    observed: growl=left (probability 0.5)" in lines
    assert "    tiger  left 0.85  right 0.15" in lines
    # 0.85^2 + 0.15^2, and then 0.85^2 / (0.85^2 + 0.15^2)
    assert "    observed: growl=left (probability 0.745)" in lines
    assert "    tiger  left 0.97  right 0.0302" in lines
    assert "3. open_right   flat" in lines
    assert "    observed: growl=right (probability 0.5)" in lines  # a new tiger is heard on either side
    assert lines[-4].split() == ["tiger", "left", "0.5", "right", "0.5"]
    likelihood = 2 * math.log(0.5) + math.log(0.85**2 + 0.15**2)
    assert lines[-1] == f"3 steps; log-likelihood of what was observed {likelihood:.6g}"


def test_an_impossible_observation_is_said_so_and_asked_again(say: Say) -> None:
    """East of s0 is s1, with walls in the north and the south."""
    out = done(say("run", "cheese_taxi.polca", "--belief", "taxi=s0", lines="none\nstop\nnorth_south\n"))
    said = [line.strip() for line in out.splitlines() if "impossible" in line]
    assert len(said) == 2
    for line, value in zip(said, ("none", "stop"), strict=True):
        assert line.startswith(f"observation 'walls={value}'") or f"walls={value}" in line
        assert "after action 'East'" in line
    assert "observed: walls=north_south (probability 1)" in out
    assert out.splitlines()[-1].startswith("1 step;")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("lefft", "'lefft' is not observed here; what is: growl (left, right)"),
        ("growl=lefft", "growl has no value 'lefft'; it has left, right"),
        ("howl=left", "'howl' is not observed here; what is: growl (left, right)"),
        ("left right", "'right' is not observed here"),
        ("growl=left growl=right", "growl is given twice"),
        ("", "a value is needed for growl (left, right)"),
        ("ended", "no episode of this model ever ends"),
        ('growl="left', "a quote is not closed"),
    ],
)
def test_a_misspelt_observation_is_asked_again_with_what_is_allowed(say: Say, line: str, said: str) -> None:
    out = done(say("run", "tiger.polca", lines=f"{line}\nright\n"))
    assert said in out
    assert "observed: growl=right (probability 0.5)" in out
    assert out.count("growl (left, right)> ") == 3  # the wrong one, the right one, the end


def test_capitals_and_quotes_do_not_matter_where_there_is_no_doubt(say: Say) -> None:
    out = done(say("run", "tiger.polca", lines='GROWL = Left\n"left"\n'))
    assert out.count("observed: growl=left") == 2


def test_what_can_be_answered_is_listed_with_probabilities(say: Say) -> None:
    out = done(say("run", "meds.polca", lines="?\n"))
    listed = [line.split() for line in out.splitlines() if line.startswith("         0.")]
    assert listed == [
        ["0.3", "word=meds"],
        ["0.3", "word=kitchen"],
        ["0.3", "word=bedroom"],
        ["0.1", "word=noise"],
    ]
    assert "back takes the last step back, quit ends the dialogue" in out


def test_back_takes_the_last_step_back(say: Say) -> None:
    straight = parsed(say("run", "tiger.polca", "--json", "-q", lines="left\nright\n"))
    turned = parsed(
        say("run", "tiger.polca", "--json", "-q", lines="back\nleft\nleft\nback\nback\nleft\nright\n")
    )
    assert turned == straight
    assert "there is no step to take back" in done(say("run", "tiger.polca", lines="back\n"))


def test_an_empty_line_is_the_null_value_or_what_alone_is_possible(say: Say) -> None:
    out = done(say("run", "meds.polca", lines="\n\n"))
    assert out.count("observed: word=noise (probability 0.1)") == 2
    data = parsed(say("run", "cheese_taxi.polca", "--belief", "taxi=s1", "--json", "-q", lines="\n"))
    step = data["steps"][0]
    assert step["likelihood"] == pytest.approx(1.0)  # walls are exact: one reading after each move
    assert set(step["observation"]) == {"walls"}


def test_what_is_seen_at_the_start_is_asked_for(say: Say) -> None:
    out = done(say("run", "finish.polca", lines="?\n5\nplace=2\nquit\n"))
    assert out.splitlines()[0] == "seen at the start, place (0, 1, 2)> ?"
    assert "'5' is not observed here; what is: place (0, 1, 2)" in out
    assert "is impossible" in out  # place 2 has the probability 0
    good = done(say("run", "finish.polca", lines="1\nquit\n"))
    assert "1. " in good
    assert "sure: place=1" in good
    assert "seen at the start" not in done(say("run", "finish.polca", "--belief", "place=1"))


def finish_until(say: Say, *lines: str) -> Any:
    arguments = ("run", "finish.polca", "--belief", "place=1,lamp=true", "--json", "-q")
    return parsed(say(*arguments, lines="\n".join(lines) + "\n"))


def test_the_end_of_an_episode_is_told_or_understood(say: Say) -> None:
    """From place 1 with the lamp lit a step ends the episode (0.8), or nothing happens."""
    first = finish_until(say)["steps"][0]
    assert first["action"] == "step"
    told = finish_until(say, "ended")
    assert told["ended"]
    assert [step["ended"] for step in told["steps"]] == [True]
    assert told["steps"][0]["likelihood"] == pytest.approx(0.8)
    assert told["log_likelihood"] == pytest.approx(math.log(0.8))
    understood = finish_until(say, "place=2")  # with the lamp lit that is the end
    assert understood["ended"]
    assert understood["steps"][0]["observation"] == {"place": 2}
    on = finish_until(say, "1", "1")
    assert [step["likelihood"] for step in on["steps"]] == [
        pytest.approx(0.2), pytest.approx(0.2), None,
    ]  # fmt: skip
    out = done(say("run", "finish.polca", "--belief", "place=1,lamp=true", lines="ended\n"))
    assert "and the episode has ended (probability 0.8)" in out
    assert out.splitlines()[-1].startswith("1 step; the episode has ended;")
    wrong = done(say("run", "finish.polca", "--belief", "place=0,lamp=false", lines="ended\n"))
    assert "is impossible" in wrong


def test_steps_are_counted(say: Say) -> None:
    data = parsed(say("run", "tiger.polca", "--steps", "2", "--json", "-q", lines="left\nright\nleft\n"))
    assert [step["observation"] for step in data["steps"]] == [{"growl": "left"}, {"growl": "right"}, None]


def test_json_is_one_object_and_the_dialogue_on_stderr(say: Say) -> None:
    status, out, err = say("run", "tiger.polca", "--json", lines="left\nquit\nleft\n")
    data = json.loads(out)
    assert status == 0
    assert "observed: growl=left" in err
    assert set(data) == {
        "model", "tracker", "tracker_reason", "steps", "ended", "log_likelihood", "peak_memory_bytes",
    }  # fmt: skip
    first, pending = data["steps"]
    assert first["action"] == "listen"
    assert first["likelihood"] == pytest.approx(0.5)
    assert first["beliefs"] == {
        "tiger": [{"value": "left", "probability": 0.5}, {"value": "right", "probability": 0.5}]
    }
    assert pending["beliefs"]["tiger"][0]["probability"] == pytest.approx(0.85)
    assert pending["observation"] is pending["likelihood"] is None


class Interrupted(io.StringIO):
    """A terminal at which Ctrl-C is pressed after the lines."""

    def readline(self, size: int | None = -1) -> str:  # type: ignore[override]
        line = super().readline(-1 if size is None else size)
        if not line:
            raise KeyboardInterrupt
        return line


def test_ctrl_c_ends_politely(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.setattr(sys, "stdin", Interrupted("left\n"))
    assert main(["run", "tiger.polca"]) == 130
    captured = capsys.readouterr()
    assert captured.out.splitlines()[-1].startswith("1 step; log-likelihood")
    assert "Traceback" not in captured.err


def test_no_input_at_all_ends_politely(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    assert main(["run", "tiger.polca"]) == 0
    assert "0 steps" in capsys.readouterr().out


def test_auto_draws_a_world_and_says_what_it_earns(say: Say) -> None:
    arguments = ("run", "finish.polca", "--auto", "--seed", "4", "--steps", "8")
    data = parsed(say(*arguments, "--json", "-q"))
    assert parsed(say(*arguments, "--json", "-q")) == data
    assert len(data["steps"]) <= 9
    rewards = [step["reward"] for step in data["steps"] if step["reward"] is not None]
    assert data["return"] == pytest.approx(sum(0.9**t * r for t, r in enumerate(rewards)))
    assert data["undiscounted_return"] == pytest.approx(sum(rewards))
    assert all(0 < step["likelihood"] <= 1 for step in data["steps"][: len(rewards)])
    out = done(say(*arguments))
    assert "; reward -1" in out
    assert "discounted" in out
    ends = [parsed(say(*arguments[:3], "--seed", str(s), "--json", "-q"))["ended"] for s in range(6)]
    assert any(ends)
    start = parsed(say("run", "finish.polca", "--auto", "--belief", "place=0,lamp=false", "--json", "-q"))
    assert start["steps"][0]["beliefs"]["place"] == [{"value": 0, "probability": 1.0}]


@pytest.mark.parametrize("kind", ["diagram", "particles"])
def test_other_trackers_work_too(say: Say, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    def forced(plan: ExecutablePomdpPlan, **options: Any) -> ChosenTracker:
        on_impossible = options["on_impossible"]
        if kind == "diagram":
            return ChosenTracker(DiagramTracker(plan.symbolic, on_impossible=on_impossible), "forced")
        return ChosenTracker(ParticleTracker(plan.symbolic, 3000, on_impossible=on_impossible), "forced")

    monkeypatch.setattr("factored_polca.cli.pilot.plan_tracker", forced)
    data = parsed(say("run", "tiger.polca", "--json", "-q", lines="left\nleft\n"))
    assert data["tracker"] == kind
    assert [step["action"] for step in data["steps"]] == ["listen", "listen", "open_right"]
    assert data["steps"][1]["likelihood"] == pytest.approx(0.745, abs=0.03)
    assert "probability" in done(say("run", "finish.polca", "--auto", "--steps", "4"))
    assert "word=noise" in done(say("run", "meds.polca", lines="?\n\n"))
    impossible = done(say("run", "cheese_taxi.polca", "--belief", "taxi=s0", lines="stop\n"))
    assert "impossible" in impossible
    found = parsed(say("simulate", "finish.polca", "--episodes", "20", "--steps", "6", "--json", "-q"))
    assert found["tracker"] == kind
    assert ("resets" in found) == (kind == "particles")


def test_a_plan_made_as_if_the_state_were_seen_is_run_at_the_likeliest_one(say: Say) -> None:
    data = parsed(say("run", "meds-seen.polca", "--auto", "--steps", "5", "--json", "-q"))
    assert all("likeliest_state" in step for step in data["steps"])
    assert "ClarifyTask" not in {step["action"] for step in data["steps"]}  # it never needs to ask
    out = done(say("run", "meds-seen.polca", lines="quit\n"))
    assert "its policy is asked at the likeliest state" in out
    assert "likeliest: wish=meds" in out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("toy.polca",), ["the state is seen", "act --state"]),
        (("none.polca",), ["no such file"]),
        (("tiger.polca", "--seed", "3"), ["--seed", "--auto"]),
        (("tiger.polca", "--steps", "0"), ["--steps", "at least 1"]),
        (("tiger.polca", "--belief", "tiger=up"), ["'up'"]),
        (("finish.polca", "--belief", "place=2,lamp=true"), ["at the start", "impossible"]),
    ],
)
def test_run_wrongly_used_is_one_error(say: Say, arguments: tuple[str, ...], said: list[str]) -> None:
    status, out, err = say("run", *arguments, lines="left\n")
    assert (status, out) == (2, "")
    assert err.count("error: ") == 1
    for part in said:
        assert part in err


def test_names_of_strangers_can_do_nothing_to_the_terminal(say: Say) -> None:
    """Brackets are no markup, and control characters that are typed are shown as escapes."""
    side = Feature("[red]side", ["a[2Jb", "c d"])
    word = Observation("w[/]", ["none", "[bold]x", "y z"])
    heard = {"[bold]x": "0.9", "y z": "0.1"}
    model = Model(
        "m[blink]",
        [side],
        [
            Action("ask[/]", senses={word: lottery(heard)}, rewards=-1),
            Action("take", {side: uniform(side)}, rewards=conditional(side.is_("c d"), 5, -5)),
        ],
        initial={side: uniform(side)},
        discount="0.5",
        observability="partial",
        observations=[word],
    )
    plan = executable_pomdp(plan_pomdp(model, flat_task(model), Options(flat_block_limit=None)))
    save_pomdp_plan(plan, "strange.polca")
    for arguments in (
        ("run", "strange.polca"),
        ("act", "strange.polca"),
        ("run", "strange.polca", "--auto"),
    ):
        out = done(say(*arguments, lines="?\nx\x1b[3m [i]\n\n"))
        assert "\x1b" not in out
        assert "[red]side" in out or "ask[/]" in out
        assert "m[blink]" in out or arguments[0] == "act"


# -- simulate --------------------------------------------------------------------------------------

SIMULATED = {
    "mean", "standard_error", "episodes", "steps", "ended", "truncation", "planned_value", "seed",
    "tracker", "tracker_reason", "action_counts", "peak_memory_bytes",
}  # fmt: skip


def test_simulating_a_plan_of_beliefs(say: Say) -> None:
    arguments = ("simulate", "meds.polca", "--episodes", "200", "--steps", "20", "--seed", "5")
    data = parsed(say(*arguments, "--json", "-q"))
    assert set(data) == {*SIMULATED, "planned_standard_error"}
    assert (data["episodes"], data["steps"], data["seed"], data["planned_value"]) == (200, 20, 5, 1.5)
    assert data["tracker"] == "blocks"
    assert sum(data["action_counts"].values()) == 200 * 20
    assert parsed(say(*arguments, "--json", "-q")) == data
    out = done(say(*arguments))
    assert f"mean return {data['mean']:.6g} ± " in out
    assert "planned value: 1.5 ± 0.25, as measured then" in out
    assert "tracker: blocks" in out
    assert "actions: ClarifyTask" in out


def test_simulating_a_plan_made_as_if_the_state_were_seen_says_so(say: Say) -> None:
    """At the likeliest state nothing is ever asked, and so two of three wishes are missed."""
    arguments = ("simulate", "meds-seen.polca", "--episodes", "2000", "--steps", "1")
    data = parsed(say(*arguments, "--json", "-q"))
    assert set(data) == {*SIMULATED, "execution"}
    assert data["action_counts"]["ClarifyTask"] == 0
    assert abs(data["mean"] - (10 - 50 - 50) / 3) <= 4 * data["standard_error"]
    assert data["planned_value"] == 2.5
    out = done(say(*arguments))
    assert "planned value: 2.5, as if the state were seen" in out
    assert "its policy is asked at the likeliest state" in out


def test_fewer_episodes_are_the_default_where_each_is_tracked_by_itself(
    say: Say, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("factored_polca.simulation.belief_episodes.EPISODES", 7)
    monkeypatch.setattr(
        "factored_polca.cli.pilot.likeliest_tracker",
        lambda plan, **options: ChosenTracker(DiagramTracker(plan.symbolic), "forced"),
    )
    data = parsed(say("simulate", "finish-seen.polca", "--steps", "3", "--json", "-q"))
    assert (data["episodes"], data["tracker"], data["tracker_reason"]) == (7, "diagram", "forced")
