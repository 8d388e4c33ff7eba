"""Plan files of partially observed models: what is saved comes back, and nothing else does any harm."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from belief_plans import NAMES, planned

from factored_polca.control import DiagramTracker
from factored_polca.control.belief_controller import BeliefController
from factored_polca.control.particle_tracker import random_history
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.hierarchy import Options, plan_pomdp
from factored_polca.hierarchy.plan_file import load_plan
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.hierarchy.pomdp_plan_file import (
    is_pomdp_plan_file,
    load_pomdp_plan,
    save_pomdp_plan,
)
from factored_polca.models import ModelError


def decisions(plan: ExecutablePomdpPlan, seed: int) -> list[Any]:
    """What a plan does along an episode of random actions, the beliefs tracked as diagrams."""
    tracker, controller = DiagramTracker(plan.symbolic), BeliefController(plan)
    first, *rest = random_history(plan.symbolic, 8, seed)
    belief = tracker.begin(plan.symbolic.initial, first)
    found = [controller.poll(belief)]
    for received in rest:
        if received.ended:
            break
        belief = belief.advance(received)
        found.append(controller.poll(belief))
    return found


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "p.polca"
    save_pomdp_plan(planned("corridor"), path)
    return path


@pytest.mark.parametrize("name", NAMES)
def test_a_saved_plan_comes_back_and_decides_the_same(name: str, tmp_path: Path) -> None:
    before, path = planned(name), tmp_path / "p.polca"
    save_pomdp_plan(before, path)
    assert is_pomdp_plan_file(path)
    after = load_pomdp_plan(path)
    assert after.model == before.model
    assert (after.root, after.tasks) == (before.root, before.tasks)
    assert after.report == {"value": 1.5, "standard_error": 0.25}
    for seed in range(5):
        assert decisions(after, seed) == decisions(before, seed)
    for task in before.policies.values():
        mine = after.policies[task.name]
        assert mine.partition.sizes == task.partition.sizes
        assert mine.actions == task.actions
        np.testing.assert_array_equal(mine.corner, task.corner)
        np.testing.assert_array_equal(mine.terminal, task.terminal)
    assert [found.name for found in tmp_path.iterdir()] == ["p.polca"]


def test_policies_by_entropy_and_plans_for_reachable_states_come_back(tmp_path: Path) -> None:
    base = planned("corridor")
    found = plan_pomdp(
        base.model, base.tasks, Options(solver="amdp", reachable=True, trials=5, flat_block_limit=None)
    )
    before = executable_pomdp(found)
    assert any(isinstance(task.policy, EntropyPolicy) for task in before.policies.values())
    save_pomdp_plan(before, tmp_path / "p.polca")
    after = load_pomdp_plan(tmp_path / "p.polca")
    for seed in range(5):
        assert decisions(after, seed) == decisions(before, seed)


def test_looking_ahead_needs_nothing_that_a_file_leaves_out(saved: Path) -> None:
    """The quotient, which a loaded plan makes again, is the one that was solved."""
    before, after = planned("corridor"), load_pomdp_plan(saved)
    for name in before.policies:
        mine, other = before.quotient(name).pomdp, after.quotient(name).pomdp
        assert mine.rewards == pytest.approx(other.rewards)
        for old, new in zip(mine.kernel, other.kernel, strict=True):
            assert sum(m.toarray() for m in old) == pytest.approx(sum(m.toarray() for m in new))


def test_a_failed_save_leaves_what_was_there(saved: Path) -> None:
    before = saved.read_bytes()
    with pytest.raises(ValueError, match="JSON"):
        save_pomdp_plan(replace(planned("corridor"), report={"value": float("nan")}), saved)
    assert saved.read_bytes() == before
    with pytest.raises(ModelError, match="no folder"):
        save_pomdp_plan(planned("corridor"), saved.parent / "none" / "p.polca")
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


# -- damage ----------------------------------------------------------------------------------------


def rewritten(saved: Path, name: str, change: Callable[[bytes], bytes | None]) -> Path:
    """The plan file with one entry changed, or left out."""
    target = saved.with_name("changed.polca")
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(target, "w") as new:
        assert name in old.namelist()
        for entry in old.namelist():
            data: bytes | None = old.read(entry)
            if entry == name:
                data = change(old.read(entry))
            if data is not None:
                new.writestr(entry, data)
    return target


def array(values: object, kind: object) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.array(values, dtype=kind), version=(1, 0), allow_pickle=True)  # type: ignore[call-overload]
    return buffer.getvalue()


def in_json(**changes: object) -> Callable[[bytes], bytes]:
    return lambda data: json.dumps({**json.loads(data), **changes}).encode()


def in_task(**changes: object) -> Callable[[bytes], bytes]:
    """The first task's entry changed."""

    def change(data: bytes) -> bytes:
        head = json.loads(data)
        head["tasks"][0] |= changes
        return json.dumps(head).encode()

    return change


def without_task(data: bytes) -> bytes:
    head = json.loads(data)
    del head["tasks"][0]
    return json.dumps(head).encode()


def fully_observed(data: bytes) -> bytes:
    text = data.decode().replace('observability = "partial"', "")
    lines = [line for line in text.splitlines() if "glimmer" not in line and "observations" not in line]
    return "\n".join(line for line in lines if not line.startswith("senses")).encode()


HEAD = "belief-plan.json"


@pytest.mark.parametrize(
    ("entry", "change", "said"),
    [
        (HEAD, in_json(format="something else"), "no plan of this program"),
        (HEAD, in_json(version=99), "version 99"),
        (HEAD, in_json(version=None), "version"),
        (HEAD, in_json(root="Go"), "tasks are not those"),
        (HEAD, in_json(tasks=[]), "tasks are not those"),
        (HEAD, without_task, "tasks are not those"),
        (HEAD, in_task(name="nobody"), "tasks are not those"),
        (HEAD, in_task(name="Root"), "tasks are not those"),
        (HEAD, in_json(order=["x"]), "variable order"),
        (HEAD, in_json(tasks=3), "missing or not what it should be"),
        (HEAD, in_json(tasks=[3]), "damaged"),
        (HEAD, in_json(report=[]), "missing or not what it should be"),
        (HEAD, in_task(blocks=1), "numbered through"),
        (HEAD, in_task(blocks=10**12), "damaged"),
        (HEAD, in_task(outside=True), "numbered through"),
        (HEAD, in_task(kind="magic"), "no kind of policy"),
        (HEAD, in_task(kind="mdp"), "damaged"),
        (HEAD, in_task(head={}), "damaged"),
        (HEAD, in_task(head={"meanings": ["certain"]}), "damaged"),
        (HEAD, lambda data: b"{", "damaged"),
        (HEAD, lambda data: b"[1]", "damaged"),
        (HEAD, lambda data: b"[" * 100_000, "damaged"),
        (HEAD, lambda data: b'{"version": NaN}', "damaged"),
        (HEAD, lambda data: None, "damaged"),
        ("model.toml", lambda data: data[: len(data) // 2], "changed.polca"),
        ("model.toml", lambda data: b"\xff\xfe", "damaged"),
        ("model.toml", lambda data: data.split(b"[tasks")[0], "no tasks"),
        ("model.toml", lambda data: data.replace(b"[tasks.Go]", b"[tasks.Gone]"), "changed.polca"),
        ("task0.leaves.npy", lambda data: array([0, 99], np.int64), "damaged"),
        ("task0.levels.npy", lambda data: array([0, 0], np.int64), "damaged"),
        ("task0.levels.npy", lambda data: array([1.5], np.float64), "damaged"),
        ("task0.children.npy", lambda data: array([10**9], np.int64), "damaged"),
        ("task0.children.npy", lambda data: array([{"an": "object"}], object), "damaged"),
        ("task0.children.npy", lambda data: data[:40], "damaged"),
        ("task0.corner.npy", lambda data: array([0], np.int64), "no action"),
        ("task0.corner.npy", lambda data: array([[0, 0]], np.int64), "damaged"),
        ("task0.corner.npy", lambda data: None, "damaged"),
        ("task0.set_vectors.npy", lambda data: array([np.inf], np.float64), "not finite"),
        ("task0.set_vectors.npy", lambda data: array([1.0] * 99, np.float64), "damaged"),
        ("task0.set_states.npy", lambda data: array([10**6], np.int64), "damaged"),
        ("task0.set_sizes.npy", lambda data: array([[10**15, 10**15]], np.int64), "damaged"),
        ("task0.set_actions.npy", lambda data: array([], np.int64), "damaged"),
    ],
)
def test_a_damaged_plan_is_refused(
    saved: Path, entry: str, change: Callable[[bytes], bytes | None], said: str
) -> None:
    with pytest.raises(ModelError, match=said) as raised:
        load_pomdp_plan(rewritten(saved, entry, change))
    assert "changed.polca" in str(raised.value)


@pytest.mark.parametrize(("name", "shift"), [("corner", 17), ("corner", -1), ("set_actions", 17)])
def test_an_action_that_a_task_has_not_is_refused(saved: Path, name: str, shift: int) -> None:
    with zipfile.ZipFile(saved) as archive:
        values = np.load(io.BytesIO(archive.read(f"task0.{name}.npy")))
    with pytest.raises(ModelError, match="action"):
        load_pomdp_plan(
            rewritten(saved, f"task0.{name}.npy", lambda data: array(values * 0 + shift, np.int64))
        )


def test_a_truncated_or_foreign_file_is_refused(saved: Path) -> None:
    data = saved.read_bytes()
    for cut in (0, 1, 100, len(data) // 2, len(data) - 1):
        saved.write_bytes(data[:cut])
        assert not is_pomdp_plan_file(saved)
        with pytest.raises(ModelError, match="no plan file of a partially observed model, or damaged"):
            load_pomdp_plan(saved)


def test_flipped_bytes_never_crash(saved: Path) -> None:
    data = bytearray(saved.read_bytes())
    generator = np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(data)
        for place in generator.integers(0, len(data), size=3):
            damaged[place] ^= int(generator.integers(1, 256))
        saved.write_bytes(bytes(damaged))
        try:
            load_pomdp_plan(saved)
        except ModelError:
            continue


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factored_polca.formats.archive.MAXIMUM_BYTES", 1 << 20)
    path = tmp_path / "bomb.polca"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(HEAD, bytes(2 << 20))
    assert path.stat().st_size < 1 << 13
    with pytest.raises(ModelError, match="larger than"):
        load_pomdp_plan(path)


def test_a_missing_file_says_how_to_make_one_and_other_plans_are_told_apart(
    saved: Path, tmp_path: Path
) -> None:
    with pytest.raises(ModelError, match=r"plan MODEL -o none\.polca"):
        load_pomdp_plan(tmp_path / "none.polca")
    with pytest.raises(ModelError):
        load_pomdp_plan(tmp_path)
    with pytest.raises(ModelError, match="not a plan file"):
        load_plan(saved)
