"""The commands of `factored-polca` on right input: what they print, with and without --json."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.text import Text

from factored_polca import __version__, library
from factored_polca.cli import main
from factored_polca.cli.output import big, escape
from factored_polca.formats import read, write

ROOT = Path(__file__).resolve().parent.parent

MINIMISE_KEYS = {
    "states", "blocks", "rounds", "nodes", "peak_nodes", "seconds", "parse_seconds", "compile_seconds",
    "total_seconds", "peak_memory_bytes",
}  # fmt: skip
PLAN_KEYS = {"model", "states", "value", "flat_value", "guarantee", "tasks"}
TASK_KEYS = {
    "name", "actions", "blocks", "q_values", "q_classes", "q_classes_shared", "value", "solver", "seconds",
}  # fmt: skip

Run = Callable[..., Any]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)
    return tmp_path


@pytest.fixture
def run_json(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command with --json; stdout must be one object on one line and nothing else."""

    def run(*arguments: str) -> Any:
        assert main([*arguments, "--json"]) == 0
        printed = capsys.readouterr().out
        assert printed.count("\n") == 1
        assert printed.endswith("\n")
        data = json.loads(printed)
        assert isinstance(data, dict)
        return data

    return run


@pytest.fixture
def run_text(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a command for people; answer what it printed on stdout."""

    def run(*arguments: str) -> str:
        assert main(list(arguments)) == 0
        return capsys.readouterr().out

    return run


def without_times(data: Any) -> Any:
    """`data` without what may differ from run to run."""
    if isinstance(data, dict):
        dropped = ("seconds", "bytes")
        return {key: without_times(item) for key, item in data.items() if not key.endswith(dropped)}
    return [without_times(item) for item in data] if isinstance(data, list) else data


# -- minimise ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "states", "blocks"),
    [
        (("taxi",), 600, 501),  # DESIGN: two independent probes
        (("linear", "--set", "size=64"), 2**64, 65),  # size + 1, Boutilier et al.'s best case
        (("expon", "--set", "size=6"), 64, 64),  # all states, their worst case
        (("components", "--set", "size=12"), 3**12, 13 * 14 // 2),  # the counts of ok and of degraded
        (("toy",), 4, 4),
    ],
)
def test_minimise_prints_known_numbers(
    run_json: Run, arguments: tuple[str, ...], states: int, blocks: int
) -> None:
    data = run_json("minimise", *arguments)
    assert data.keys() >= MINIMISE_KEYS
    assert "reachable_states" not in data
    assert (data["states"], data["blocks"]) == (states, blocks)
    assert 0 < data["nodes"] <= data["peak_nodes"]
    assert data["total_seconds"] >= data["seconds"] > 0
    assert 0 < data["collision_bound"] < 1e-15


def test_minimise_for_people_says_the_same(run_text: Run) -> None:
    words = run_text("minimise", "linear", "--set", "size=20").split()
    assert words[words.index("states") + 1] == f"{2**20:,}"
    assert words[words.index("blocks") + 1] == "21"


def test_minimise_counts_reachable_states(run_json: Run) -> None:
    """Taxi, from where nobody is aboard: passengers wait or ride (25*5*4); delivered at destinations."""
    data = run_json("minimise", "taxi", "--reachable")
    assert data["reachable_states"] == 25 * 5 * 4 + 4
    assert data["blocks"] == 501


def test_minimise_with_some_actions_only(run_json: Run) -> None:
    """Moves alone, each at -1: where the taxi is makes no difference, only whether it has ended."""
    assert run_json("minimise", "taxi", "--actions", "North,South,East,West")["blocks"] == 2


def test_minimise_exchanges_actions_where_the_state_is_seen(run_json: Run) -> None:
    named = run_json("minimise", "sysadmin", "--set", "size=5")
    exchanged = run_json("minimise", "sysadmin", "--set", "size=5", "--interchangeable")
    assert exchanged["interchangeable"]
    # Ring of five machines: necklaces of five beads in two colours, against all 2^5 states.
    assert (exchanged["blocks"], named["blocks"]) == (8, 32)


def test_minimise_counts_joint_observations_before_and_after(run_json: Run, run_text: Run) -> None:
    data = run_json("minimise", "tiger")
    counts = {name: (c["before"], c["after"]) for name, c in data["observations"].items()}
    # Behind an opened door one hears either side, each with chance 1/2 (Kaelbling et al. 1998).
    assert counts == {"listen": (2, 2), "open_left": (2, 1), "open_right": (2, 1)}
    assert "joint observations" in run_text("minimise", "tiger")
    assert "observations" not in run_json("minimise", "taxi")


def test_minimise_certifies(run_json: Run, run_text: Run) -> None:
    data = run_json("minimise", "toy", "--certify")
    assert data["certified"] is True
    assert data["certificate"]["failures"] == []
    assert "certified" in run_text("minimise", "toy", "--certify")


@pytest.mark.parametrize("order", ["auto", "file", "force", "spectral"])
def test_blocks_do_not_depend_on_the_order_of_variables(run_json: Run, order: str) -> None:
    data = run_json("minimise", "taxi", "--order", order)
    assert data["blocks"] == 501
    assert sorted(data["order"]) == ["destination", "passenger", "x", "y"]


# -- plan --------------------------------------------------------------------------------------


@pytest.mark.parametrize("slip", ["false", "true"])
def test_taxi_plans_to_the_flat_optimum(run_json: Run, slip: str) -> None:
    data = run_json("plan", "taxi", "--set", f"slip={slip}")
    assert data.keys() >= PLAN_KEYS
    assert data["states"] == 600
    assert data["value"] == pytest.approx(data["flat_value"], abs=1e-6)
    assert [task["name"] for task in data["tasks"]][-1] == "Root"
    assert all(task.keys() >= TASK_KEYS for task in data["tasks"])
    assert isinstance(data["guarantee"], str)


def test_taxi_needs_fewer_values_than_maxq(run_json: Run) -> None:
    """1520 Q-values by DESIGN's two probes; MAXQ's 632 by Dietterich (2000)."""
    data = run_json("plan", "taxi")
    assert sum(task["q_values"] for task in data["tasks"]) == 1520
    assert sum(task["q_classes_shared"] for task in data["tasks"]) < 632
    by_name = {task["name"]: task for task in data["tasks"]}
    assert by_name["Get"]["actions"][0] == "Pickup"
    assert by_name["Put"]["value"] == 0  # nobody is in the taxi at the start: Put has ended


def test_plan_for_people_shows_every_task_and_both_values(
    run_text: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    printed = run_text("plan", "taxi")
    for word in ("Navigate_R", "Navigate_B", "Get", "Put", "Root", "1,520", "3.85738595", "flat optimum"):
        assert word in printed


def test_a_model_without_tasks_gets_one_flat_task_said_aloud(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "linear", "--set", "size=4", "--json"]) == 0
    captured = capsys.readouterr()
    (task,) = json.loads(captured.out)["tasks"]
    assert task["blocks"] == 5
    assert "no tasks" in captured.err


def test_tasks_can_come_from_another_file(run_json: Run, folder: Path) -> None:
    text = '[tasks.Only]\nactions = ["red_key", "blue_key", "walk"]\n'
    (folder / "tasks.toml").write_text(text, encoding="utf-8")
    data = run_json("plan", "toy", "--tasks", "tasks.toml")
    assert [task["name"] for task in data["tasks"]] == ["Only"]
    # -1 for the key, then 10 - 1 for walking through, a step later
    assert data["value"] == pytest.approx(-1 + 0.95 * 9, abs=1e-9)


def test_the_flat_optimum_can_be_left_out(run_json: Run) -> None:
    assert run_json("plan", "toy", "--no-flat")["flat_value"] is None
    data = run_json("plan", "taxi", "--flat-blocks", "500")
    assert data["flat_value"] is None
    assert "500" in data["flat_note"]


@pytest.mark.parametrize("solver", ["vi", "pi", "mpi"])
def test_every_solver_gets_the_same_value(run_json: Run, solver: str) -> None:
    assert run_json("plan", "toy", "--solver", solver)["value"] == pytest.approx(7.55, abs=1e-8)


# -- act and simulate --------------------------------------------------------------------------


def test_act_says_the_action_and_the_path_that_leads_there(run_json: Run, run_text: Run) -> None:
    """At the red passenger's cell with the passenger waiting there, only a pickup makes sense."""
    run_json("plan", "taxi", "-o", "taxi.polca")
    state = "x=0,y=4,passenger=R,destination=B"
    data = run_json("act", "taxi.polca", "--state", state)
    assert data["action"] == "Pickup"
    assert [poll["task"] for poll in data["path"]] == ["Root", "Get"]
    assert all(poll["block_states"] >= 1 and poll["block"] >= 0 for poll in data["path"])
    assert "action: Pickup" in run_text("act", "taxi.polca", "--state", state)


def test_act_in_a_terminal_state_says_that_it_has_ended(run_json: Run, run_text: Run) -> None:
    run_json("plan", "toy", "-o", "toy.polca")
    data = run_json("act", "toy.polca", "--state", "door=passed")
    assert data["action"] is None
    assert data["path"][-1]["terminal"] is True
    assert "ended" in run_text("act", "toy.polca", "--state", "door=passed")


def test_simulate_agrees_with_the_plan_and_with_itself(run_json: Run, run_text: Run) -> None:
    run_json("plan", "toy", "-o", "toy.polca")
    data = run_json("simulate", "toy.polca", "--episodes", "50", "--seed", "3")
    assert data.keys() >= {"mean", "standard_error", "episodes"}
    assert data["mean"] == pytest.approx(-1 + 0.95 * 9)  # nothing is random but the colour
    assert data["standard_error"] == pytest.approx(0)
    assert data["episodes"] == 50
    assert "mean return" in run_text("simulate", "toy.polca")


def test_a_single_episode_has_no_standard_error(run_json: Run) -> None:
    run_json("plan", "toy", "-o", "toy.polca")
    assert run_json("simulate", "toy.polca", "--episodes", "1")["standard_error"] is None


@pytest.mark.parametrize(
    "arguments",
    [
        ("minimise", "taxi", "--seed", "5"),
        ("plan", "taxi", "--seed", "5", "--set", "slip=true"),
        ("simulate", "made.polca", "--seed", "5", "--episodes", "200"),
    ],
)
def test_the_same_seed_gives_the_same_output(run_json: Run, arguments: tuple[str, ...]) -> None:
    run_json("plan", "taxi", "--set", "slip=true", "-o", "made.polca")
    assert without_times(run_json(*arguments)) == without_times(run_json(*arguments))


def test_another_seed_simulates_other_episodes(run_json: Run) -> None:
    run_json("plan", "taxi", "--set", "slip=true", "-o", "made.polca")
    means = {run_json("simulate", "made.polca", "--seed", str(seed))["mean"] for seed in range(3)}
    assert len(means) == 3


# -- domains, info, check, new, convert ----------------------------------------------------------


def test_domains_lists_every_domain(run_json: Run, run_text: Run) -> None:
    names = [row["name"] for row in run_json("domains")["domains"]]
    assert names == list(library.domains())
    printed = run_text("domains")
    assert all(name in printed for name in names)


def test_info_lists_parameters_with_their_defaults(run_json: Run, run_text: Run) -> None:
    data = run_json("info", "taxi", "--set", "size=4")
    assert data["states"] == 16 * 6 * 4
    assert {p["name"]: p["default"] for p in data["domain_parameters"]} == {
        "size": "5", "slip": "false", "anywhere": "false", "noise_bits": "0", "discount": "19/20",
    }  # fmt: skip
    assert "Dietterich" in data["documentation"]
    assert "noise_bits" in run_text("info", "taxi")


def test_info_counts_states_however_many(run_json: Run, run_text: Run, folder: Path) -> None:
    """10^5000 has more digits than Python turns into text unasked."""
    features = "\n".join(f'f{i} = "0..9"' for i in range(5000))
    head = 'name = "wide"\ndiscount = 0.9\nreward = 1\n[features]\n'
    text = f'{head}{features}\n[actions.a]\neffects.f0 = "0"\n'
    (folder / "wide.toml").write_text(text, encoding="utf-8")
    limit = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(6000)
    try:
        assert run_json("info", "wide.toml")["states"] == 10**5000
        assert sys.get_int_max_str_digits() == 6000
    finally:
        sys.set_int_max_str_digits(limit)
    assert "10^5000" in run_text("info", "wide.toml")


def test_check_finds_no_fault_in_shipped_domains(run_json: Run, run_text: Run) -> None:
    for name in ("toy", "taxi", "linear"):
        data = run_json("check", name)
        assert (data["model"], data["ok"], data["faults"]) == (name, True, [])
    assert "no fault" in run_text("check", "toy")


def test_what_new_writes_passes_check_and_plans(run_json: Run, run_text: Run) -> None:
    assert "robot.toml" in run_text("new", "robot")
    assert run_json("check", "robot.toml")["ok"] is True
    data = run_json("plan", "robot.toml")
    assert data["model"] == "robot"
    assert data["value"] <= data["flat_value"] + 1e-9


def test_new_never_overwrites(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "mine.toml").write_text("mine", encoding="utf-8")
    assert main(["new", "mine"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (folder / "mine.toml").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in folder.iterdir()] == ["mine.toml"]


def test_convert_writes_a_model_that_reads_the_same(run_json: Run, folder: Path) -> None:
    assert run_json("convert", "taxi", "taxi.toml")["states"] == 600
    domain = library.load("taxi")
    document = read(folder / "taxi.toml")
    assert (document.model, document.tasks) == (domain.model, domain.tasks)
    run_json("convert", "linear", "small.dat", "--set", "size=3")
    assert run_json("minimise", "small.dat")["blocks"] == 4


@pytest.mark.parametrize("name", ["t.POMDP", "t.pomdpx", "t.PomdpX", "t.dat", "t.SPUDD", "t.TOML"])
@pytest.mark.parametrize("options", [("--no-tasks",), ("--minimise",)])
def test_convert_writes_every_format_and_info_reads_it(
    run_json: Run, folder: Path, name: str, options: tuple[str, ...]
) -> None:
    run_json("convert", "tiger", name, *options)
    found = run_json("info", name)
    assert (found["states"], found["observability"], len(found["actions"])) == (2, "partial", 3)
    assert run_json("solve", name)["lower"] == pytest.approx(19.371368, abs=1e-3)


def test_convert_lists_states_or_blocks(run_json: Run, folder: Path) -> None:
    data = run_json("convert", "linear", "blocks.pomdp", "--set", "size=40", "--minimise")
    assert (data["file"], data["states"], data["blocks"]) == ("blocks.pomdp", 2**40, 41)
    assert run_json("info", "blocks.pomdp")["observability"] == "full"
    assert run_json("convert", "linear", "flat.mdp", "--set", "size=3", "--no-tasks")["listed"] == 4
    assert run_json("convert", "nursebot", "n.npz", "--no-tasks")["listed"] > 100
    assert run_json("convert", "tiger", "t.npz", "--minimise")["blocks"] == 2
    run_json("convert", "tiger", "later.pomdp", "--minimise", "--first-step")
    assert run_json("info", "later.pomdp")["states"] == 7  # 2 for each of 3 observations, and the first


def test_a_file_wins_over_a_domain_of_the_same_name(run_json: Run, folder: Path) -> None:
    toy = library.load("toy")
    write(toy.model, folder / "copy.toml", toy.tasks)
    (folder / "taxi").mkdir()
    assert main(["info", "taxi"]) == 2  # a folder stands where a file is expected: said, not guessed
    (folder / "taxi").rmdir()
    assert run_json("info", "taxi")["states"] == 600
    (folder / "copy.toml").rename(folder / "taxi")
    assert main(["info", "taxi"]) == 2  # a file without an extension: its format is unknown


# -- the program itself ------------------------------------------------------------------------


def test_it_tells_its_version_and_helps(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"factored-polca {__version__}\n"
    assert main(["plan", "--help"]) == 0
    assert "--tasks" in capsys.readouterr().out


def test_quiet_leaves_stderr_empty(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["minimise", "toy", "--quiet"]) == 0
    assert capsys.readouterr().err == ""


def test_markup_in_names_is_shown_as_it_is(run_text: Run, run_json: Run, folder: Path) -> None:
    name = "[red]no markup[/] :smile:"
    text = (
        'name = "[red]no markup[/] :smile:"'
        "\ndiscount = 0.9\nreward = [1, 'a == \"[/]\"']\n[features]\n"
        'a = ["[bold]", "[/]"]\n[actions.go]\neffects.a = \'{"[bold]": 1/2, "[/]": 1/2}\'\n'
    )
    (folder / "odd.toml").write_text(text, encoding="utf-8")
    for command in ("info", "minimise", "plan"):
        printed = run_text(command, "odd.toml")
        assert name in printed
    assert "[bold], [/]" in run_text("info", "odd.toml")
    assert run_json("info", "odd.toml")["model"] == name


def test_control_characters_in_names_are_refused_and_shown_as_escapes(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = 'name = "odd \\u001b[31m"\ndiscount = 0.9\n[features]\na = "0..1"\n[actions.go]\n'
    (folder / "odd.toml").write_text(text, encoding="utf-8")
    assert main(["info", "odd.toml"]) == 2
    said = capsys.readouterr().err
    assert "odd.toml:1:9: " in said
    assert "\x1b" not in said


def test_escape_leaves_letters_of_all_scripts() -> None:
    for text, seen in [("größe 大きさ", "größe 大きさ"), ("[b]\x1b[0m\x07\u202e", r"[b]\x1b[0m\x07\u202e")]:
        assert Text.from_markup(escape(text)).plain == seen


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0"), (600, "600"), (2**64, f"{2**64:,}"), (3**60, "4.2391e+28"), (10**400, "10^400.0")],
)
def test_large_numbers_are_written_short(number: int, text: str) -> None:
    assert big(number) == text


def child(arguments: list[str], **more: Any) -> subprocess.Popen[str]:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "factored_polca", *arguments]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, **more
    )


def test_as_a_process_it_prints_one_object_and_answers_its_status() -> None:
    with child(["minimise", "taxi", "--json"]) as process:
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0
    assert json.loads(out)["blocks"] == 501
    assert "minimising taxi" in err


@pytest.mark.parametrize("arguments", [["info", "taxi"], ["domains", "--json"], ["minimise", "toy"]])
def test_a_pipe_that_closes_early_is_no_traceback(arguments: list[str]) -> None:
    with child(arguments) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        process.wait(timeout=120)
        err = process.stderr.read()
    assert process.returncode == 1
    assert "Traceback" not in err
    assert "BrokenPipe" not in err


@pytest.mark.parametrize("kind", ["q", "value", "action"])
def test_a_plan_stored_over_classes_acts_alike(run_json: Run, run_text: Run, kind: str) -> None:
    whole = run_json("plan", "taxi", "--set", "size=3", "-o", "whole.polca")
    less = run_json("plan", "taxi", "--set", "size=3", "-o", "less.polca", "--store", kind)
    assert less["stored"]["by"] == kind
    assert less["stored"]["blocks"] == sum(row["blocks"] for row in whole["tasks"])
    assert less["stored"]["classes"] == sum(row["value_classes"][kind] for row in whole["tasks"])
    assert less["stored"]["classes"] < less["stored"]["blocks"]
    for name in ("whole", "less"):
        run_json("simulate", f"{name}.polca", "--episodes", "50")
    assert without_times(run_json("simulate", "whole.polca", "--episodes", "50")) == without_times(
        run_json("simulate", "less.polca", "--episodes", "50")
    )
    shown = run_text("plan", "toy", "-o", "toy.polca", "--store", kind, "-q")
    assert f"stored by {kind}: " in shown


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("plan", "toy", "--store", "q"), "give -o PLAN too"),
        (("plan", "tiger", "--store", "q", "-o", "x.polca"), "whose state is seen"),
        (("plan", "toy", "--store", "q", "-o", "x.polca", "--interchangeable"), "needs actions by name"),
    ],
)
def test_what_cannot_be_stored_over_classes_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    assert main(list(arguments)) == 2
    assert said in capsys.readouterr().err
