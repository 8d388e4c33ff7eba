"""What an unkind user tries: special files, closed streams, narrow terminals, huge numbers."""

from __future__ import annotations

import os
import pickle
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from random_models import random_model, random_tasks

import factored_polca as fp
from factored_polca.cli import main
from factored_polca.hierarchy import plan
from factored_polca.models import Action, Feature, Model, ModelError, Task, TaskHierarchy

COMMAND = [sys.executable, "-m", "factored_polca"]


@pytest.mark.parametrize("command", [("plan", "toy", "-q", "-o"), ("convert", "toy")])
def test_a_pipe_in_the_file_s_place_is_refused_and_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: tuple[str, ...]
) -> None:
    path = tmp_path / "pipe.toml"
    os.mkfifo(path)
    assert main([*command, str(path)]) == 2
    assert "device, a pipe or a socket" in capsys.readouterr().err
    assert stat.S_ISFIFO(path.stat().st_mode)
    assert [entry.name for entry in tmp_path.iterdir()] == ["pipe.toml"]


@pytest.mark.parametrize("command", [("plan", "toy", "-q", "-o"), ("convert", "toy")])
def test_a_link_is_followed(tmp_path: Path, command: tuple[str, ...]) -> None:
    target, link = tmp_path / "real.toml", tmp_path / "link.toml"
    target.write_text("old")
    link.symlink_to(target)
    assert main([*command, str(link)]) == 0
    assert link.is_symlink()
    assert target.read_bytes() != b"old"


def ending_early() -> tuple[Model, TaskHierarchy]:
    """The root ends at x == 2; what comes after, where every step costs 10, is not its business."""
    x = Feature("x", range(5))
    model = Model(
        "early",
        [x],
        [Action("on", {x: "min(x + 1, 4)"}), Action("stay", {})],
        rewards="-10 if x >= 2 else 1",
        initial={x: "{0: 1}"},
    )
    return model, TaskHierarchy([Task("root", ["on"], terminal="x >= 2")])


def test_the_flat_optimum_ends_where_the_root_ends() -> None:
    model, tasks = ending_early()
    found = plan(model, tasks)
    assert found.flat is not None
    assert found.polled.value == pytest.approx(1 + 0.95)
    assert found.flat.value == pytest.approx(1 / 0.05)  # staying earns 1 for ever
    assert found.polled.value <= found.flat.value


def test_kernels_are_announced_once(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    said = []
    for _ in range(2):
        done = subprocess.run([*COMMAND, "plan", "toy"], capture_output=True, text=True, env=environment)
        assert done.returncode == 0
        said.append("compiling numeric kernels" in done.stderr)
    assert said == [True, False]


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", ">&- 2>&-"])
def test_closed_streams_do_no_harm(closed: str) -> None:
    line = f"{sys.executable} -m factored_polca plan toy -q {closed}"
    done = subprocess.run(["sh", "-c", line], capture_output=True, text=True)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


def test_letters_that_an_encoding_lacks_are_escaped(tmp_path: Path) -> None:
    path = tmp_path / "m.toml"
    path.write_text('name = "é"\ndiscount = 0.9\n[features]\nx = "0..1"\n[actions.a]\n', encoding="utf-8")
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run([*COMMAND, "info", str(path)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0
    assert r"\xe9" in done.stdout


def test_a_narrow_terminal_cuts_no_number(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    assert main(["plan", "taxi", "-q"]) == 0
    printed = capsys.readouterr().out
    for text in ("Navigate_R", "-4.19677", "1,520", "1,073", "528"):
        assert text in printed


@pytest.mark.parametrize("reward", ["x * 2 ** 1000", "x * 1e300 * 1e300"])
def test_a_reward_beyond_floats_is_a_fault_of_the_model(
    reward: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "m.toml"
    text = (
        f'discount = 0.9\nreward = "{reward}"\n[features]\nx = "0..1"\n[actions.a]\neffects.x = "1 - x"\n'
    )
    path.write_text(text)
    assert main(["plan", str(path)]) == 2
    assert "scale the rewards down" in capsys.readouterr().err


@pytest.mark.parametrize("seed", range(5))
def test_models_and_tasks_are_pickled(seed: int) -> None:
    model = random_model(seed, max_states=36)
    tasks = random_tasks(seed, model)
    again = pickle.loads(pickle.dumps((model, tasks)))
    assert again == (model, tasks)
    assert hash(again[0].terminal) == hash(model.terminal)


def test_a_state_outside_the_plan_is_said_to_be_outside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "m.toml"
    path.write_text(
        'discount = 0.9\nreward = "x"\nterminal = "x == 2"\n[features]\nx = "0..3"\n[initial]\nx = "0"\n'
        '[actions.on]\neffects.x = "min(x + 1, 3)"\n[actions.back]\neffects.x = "max(x - 1, 0)"\n'
    )
    saved = str(tmp_path / "m.polca")
    assert main(["plan", str(path), "--reachable", "-q", "-o", saved]) == 0
    assert main(["act", saved, "--state", "x=3"]) == 0
    assert "outside the states that were planned for" in capsys.readouterr().out


def test_check_sees_an_unknown_solver(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "m.toml"
    path.write_text(
        'discount = 0.9\nreward = "x"\n[features]\nx = "0..1"\n[actions.a]\neffects.x = "1 - x"\n'
        '[actions.b]\n[tasks.T]\nactions = ["a", "b"]\nsolver = "magic"\n'
    )
    assert main(["check", str(path)]) == 2
    assert "magic" in capsys.readouterr().err


def test_a_wrong_term_of_all_actions_is_reported_once() -> None:
    x = Feature("x", range(2))
    model = Model("m", [x], [Action("a"), Action("b"), Action("c")], rewards="1 / x")
    with pytest.raises(ModelError) as caught:
        fp.compile_model(model)
    assert len(caught.value.faults) == 1


@pytest.mark.parametrize("wrong", ["taxi", None, 3])
def test_plan_says_what_it_takes(wrong: object) -> None:
    with pytest.raises(TypeError, match="takes a Model"):
        fp.plan(wrong)  # type: ignore[arg-type]


def test_plan_says_what_tasks_are() -> None:
    model, tasks = ending_early()
    with pytest.raises(TypeError, match="TaskHierarchy"):
        fp.plan(model, list(tasks.tasks))  # type: ignore[arg-type]


def test_a_plan_whose_policy_does_not_follow_from_its_tasks_is_refused(tmp_path: Path) -> None:
    import io
    import zipfile

    import numpy as np

    from factored_polca.hierarchy.executable import executable
    from factored_polca.hierarchy.plan_file import load_plan, save_plan

    domain = fp.load_domain("toy")
    saved, changed = tmp_path / "a.polca", tmp_path / "b.polca"
    save_plan(executable(plan(domain.model, domain.tasks)), saved)
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "policy.leaves.npy":
                leaves = np.load(io.BytesIO(data))
                buffer = io.BytesIO()
                np.save(buffer, leaves[::-1].copy())
                data = buffer.getvalue()
            new.writestr(name, data)
    with pytest.raises(ModelError, match="not what its tasks choose"):
        load_plan(changed)


def test_a_state_may_have_commas_and_look_alikes_in_quotes() -> None:
    from factored_polca.cli.source import parse_state

    odd = Feature("a, b=c", ["x, y", "=", "plain"])
    mixed = Feature("m", ["1", 1, True, "true"])
    model = Model("m", [odd, mixed], [Action("a")])
    for text, expected in (
        ('"a, b=c"="x, y",m=1', {"a, b=c": "x, y", "m": 1}),
        (' "a, b=c" = "=" , m = "1" ', {"a, b=c": "=", "m": "1"}),
        ('m=true,"a, b=c"=plain', {"a, b=c": "plain", "m": True}),
        ('m="true","a, b=c"="plain"', {"a, b=c": "plain", "m": "true"}),
    ):
        found = parse_state(text, model)
        assert found == expected
        assert {k: type(v) for k, v in found.items()} == {k: type(v) for k, v in expected.items()}
