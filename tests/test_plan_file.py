"""Plan files: what is saved comes back, and nothing else does any harm."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from random_models import random_model, random_tasks

from factored_polca import library
from factored_polca.control import Controller
from factored_polca.hierarchy import plan
from factored_polca.hierarchy.executable import ExecutablePlan, executable
from factored_polca.hierarchy.plan_file import load_plan, save_plan
from factored_polca.models import Model, ModelError


def all_states(model: Model) -> np.ndarray:
    grids = np.meshgrid(*(np.arange(len(f.values)) for f in model.features), indexing="ij")
    return np.stack([grid.ravel() for grid in grids], axis=1).astype(np.int32)


def planned(name: str) -> ExecutablePlan:
    domain = library.load(name, {"size": "3"} if name == "taxi" else {})
    return executable(plan(domain.model, domain.tasks), {"value": 1.5})


@pytest.fixture(scope="module")
def taxi() -> ExecutablePlan:
    return planned("taxi")


@pytest.fixture
def saved(taxi: ExecutablePlan, tmp_path: Path) -> Path:
    path = tmp_path / "taxi.polca"
    save_plan(taxi, path)
    return path


def assert_same(a: ExecutablePlan, b: ExecutablePlan) -> None:
    states = all_states(a.model)
    assert a.model == b.model
    assert a.root == b.root
    assert (Controller(a).actions(states) == Controller(b).actions(states)).all()
    for name, policy in a.policies.items():
        other = b.policies[name]
        assert policy.actions == other.actions
        assert (policy.choice == other.choice).all()
        assert (policy.values == other.values).all()
        assert policy.partition.sizes == other.partition.sizes


@pytest.mark.parametrize("name", ["taxi", "toy"])
def test_a_saved_plan_comes_back(name: str, tmp_path: Path) -> None:
    plan_before = planned(name)
    save_plan(plan_before, tmp_path / "p.polca")
    after = load_plan(tmp_path / "p.polca")
    assert_same(plan_before, after)
    assert after.report == {"value": 1.5}
    assert [path.name for path in tmp_path.iterdir()] == ["p.polca"]


@pytest.mark.parametrize("seed", [1, 2, 3, 5, 8])
def test_random_hierarchies_come_back(seed: int, tmp_path: Path) -> None:
    model = random_model(seed, features=(2, 3), max_states=36)
    found = executable(plan(model, random_tasks(seed, model)))
    save_plan(found, tmp_path / "p.polca")
    assert_same(found, load_plan(tmp_path / "p.polca"))


def test_a_failed_save_leaves_what_was_there(taxi: ExecutablePlan, saved: Path) -> None:
    before = saved.read_bytes()
    broken = ExecutablePlan(
        taxi.symbolic, taxi.tasks, taxi.root, taxi.policies, taxi.policy, {"value": float("nan")}
    )
    with pytest.raises(ValueError, match="JSON"):
        save_plan(broken, saved)
    assert saved.read_bytes() == before
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def rewritten(saved: Path, name: str, change: Callable[[bytes], bytes | None]) -> Path:
    """The plan file with one entry changed, or left out."""
    target = saved.with_name("changed.polca")
    with zipfile.ZipFile(saved) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.namelist():
            data: bytes | None = old.read(entry)
            if entry == name:
                data = change(old.read(entry))
            if data is not None:
                new.writestr(entry, data)
    return target


def array(values: object, kind: object) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array(values, dtype=kind), allow_pickle=True)  # type: ignore[call-overload]
    return buffer.getvalue()


def in_json(**changes: object) -> Callable[[bytes], bytes]:
    return lambda data: json.dumps({**json.loads(data), **changes}).encode()


@pytest.mark.parametrize(
    ("entry", "change", "said"),
    [
        ("plan.json", in_json(format="something else"), "no plan of this program"),
        ("plan.json", in_json(version=99), "version 99"),
        ("plan.json", in_json(root="nobody"), "tasks are not those"),
        ("plan.json", in_json(tasks=[]), "tasks are not those"),
        ("plan.json", in_json(order=["x"]), "variable order"),
        ("plan.json", in_json(tasks=3), "damaged"),
        ("plan.json", lambda data: b"{", "damaged"),
        ("plan.json", lambda data: b"[" * 100_000, "damaged"),
        ("plan.json", lambda data: None, "damaged"),
        ("model.toml", lambda data: data[: len(data) // 2], "changed.polca"),
        ("model.toml", lambda data: b"\xff\xfe", "damaged"),
        ("model.toml", lambda data: data.split(b"[tasks")[0], "no tasks"),
        ("policy.leaves.npy", lambda data: array([0, 99], np.uint64), "damaged"),
        ("policy.levels.npy", lambda data: array([0, 0], np.int64), "damaged"),
        ("policy.children.npy", lambda data: array([10**9], np.int64), "damaged"),
        ("policy.children.npy", lambda data: array([{"an": "object"}], object), "damaged"),
        ("policy.children.npy", lambda data: data[:40], "damaged"),
        ("task0.choice.npy", lambda data: array([0, 1], np.int32), "damaged"),
        ("task0.values.npy", lambda data: array(["a"], np.str_), "damaged"),
        ("task0.terminal.npy", lambda data: None, "damaged"),
    ],
)
def test_a_damaged_plan_is_refused(
    saved: Path, entry: str, change: Callable[[bytes], bytes | None], said: str
) -> None:
    with pytest.raises(ModelError, match=said):
        load_plan(rewritten(saved, entry, change))


def test_a_policy_that_chooses_what_there_is_not_is_refused(saved: Path, taxi: ExecutablePlan) -> None:
    name = next(iter(taxi.policies))
    wrong = taxi.policies[name].choice.copy()
    wrong[0] = 17
    with pytest.raises(ModelError, match="action that its task has not"):
        load_plan(rewritten(saved, "task0.choice.npy", lambda data: array(wrong, np.int32)))


def test_a_truncated_or_foreign_file_is_refused(saved: Path) -> None:
    data = saved.read_bytes()
    for cut in (0, 1, 100, len(data) // 2, len(data) - 1):
        saved.write_bytes(data[:cut])
        with pytest.raises(ModelError, match="not a plan file"):
            load_plan(saved)


def test_flipped_bytes_never_crash(saved: Path) -> None:
    data = bytearray(saved.read_bytes())
    generator = np.random.default_rng(0)
    for _ in range(60):
        damaged = bytearray(data)
        for place in generator.integers(0, len(data), size=3):
            damaged[place] ^= int(generator.integers(1, 256))
        saved.write_bytes(bytes(damaged))
        try:
            load_plan(saved)
        except ModelError:
            continue


def test_a_missing_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="plan MODEL -o"):
        load_plan(tmp_path / "none.polca")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError):
        load_plan(tmp_path)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factored_polca.hierarchy.plan_file.MAXIMUM_BYTES", 1 << 20)
    path = tmp_path / "bomb.polca"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("plan.json", bytes(2 << 20))
    assert path.stat().st_size < 1 << 13
    with pytest.raises(ModelError, match="larger than a plan"):
        load_plan(path)
