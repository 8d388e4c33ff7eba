"""Runs of a study: limits that hold, orphans that there are not, equal tables wherever they are run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from benchmarks.study_kills import rehearse
from study_functions import MIB

from factored_polca.studies import Cluster, Study, limits
from factored_polca.studies.limits import descendants, kill_tree, resident_bytes, tree_bytes
from factored_polca.studies.runner import Progress
from factored_polca.studies.warden_client import Warden, WorkerLost, run_here, this_client

TESTS = Path(__file__).resolve().parent
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="orphans are found through /proc")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the current one; processes find the functions that they run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))
    return tmp_path


def function(name: str, **more: Any) -> dict[str, Any]:
    return {"work": f"study_functions:{name}", **more}


def until(condition: Callable[[], bool], seconds: float = 30.0) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)


def gone(process: int) -> bool:
    """Whether a process has ended, waited for or not."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return True
    return state in "ZX"


# -- what runs find --------------------------------------------------------------------------------


def test_runs_find_what_is_known_of_their_models() -> None:
    """linear merges 2^n states into n + 1 blocks, expon none (Boutilier et al. 2000); README's values."""
    study = Study("known", [
        {"work": "minimise", "model": ["linear", "expon"], "set": {"size": [3, 5]}},
        {"work": "plan", "model": "taxi"},
        {"work": "solve", "model": "tiger", "solver": "sarsop", "gap": 1e-4},
        {"work": "solve", "model": "taxi", "solver": ["auto", "vi"], "gap": 1e-6},
        {"work": "solve", "model": "toy", "horizon": 3},
    ], jobs=2)  # fmt: skip
    assert study.run().by_status["ok"] == len(study.runs()) == 9
    rows = study.rows()
    blocks = {(r["model"], r["set.size"]): r["blocks"] for r in rows if r["work"] == "minimise"}
    assert blocks == {("linear", 3): 4, ("linear", 5): 6, ("expon", 3): 8, ("expon", 5): 32}
    assert [r["states"] for r in rows[:2]] == ["8", "32"]
    assert rows[4]["value"] == pytest.approx(3.85738595, abs=5e-9)
    assert rows[5]["lower"] <= 19.3713684 <= rows[5]["upper"]
    assert rows[5]["gap"] <= 1e-4
    for row in rows[6:8]:
        assert row["lower"] <= 3.857385955  # README's digits
        assert row["upper"] >= 3.857385945
        assert row["gap"] <= 1e-6
    for row in rows:
        assert row["stage"] == "done"
        assert 0 <= row["seconds"] <= row["wall_seconds"]
        assert row["compile_seconds"] >= 0
        assert row["cpu_seconds"] > 0
        assert row["peak_memory_bytes"] >= row["base_memory_bytes"] > 20 * MIB


def test_kernels_are_made_ready_once_ahead_of_the_runs() -> None:
    study = Study("warm", [{"work": "minimise", "model": "linear", "set": {"size": 4}, "seed": "0..3"}])
    study.run()
    from factored_polca.studies import Store

    with Store(study.store) as store:
        (supervisor,) = store.supervisors()
    assert set(supervisor["warm_seconds"]) == {"diagrams"}
    assert supervisor["forks"] is (sys.platform == "linux")
    assert [row["compile_seconds"] for row in study.rows()] == [0, 0, 0, 0]


def test_a_model_file_is_run_from_its_text(folder: Path) -> None:
    from factored_polca.cli import main

    assert main(["new", "robot", "-q"]) == 0
    study = Study("file", [{"work": "minimise", "model": "robot.toml"}])
    (folder / "robot.toml").write_text("nonsense")  # read before
    assert study.run().by_status["ok"] == 1
    broken = Study("broken", [{"work": "minimise", "model": "robot.toml"}])
    assert broken.run().by_status["error"] == 1
    (row,) = broken.rows()
    assert "robot.toml:1:9: no TOML" in row["message"]
    assert row["stage"] == "reading the model"


def test_results_are_a_frame_a_file_and_a_page(folder: Path) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("matplotlib")
    study = Study("squares", [function("square", set={"n": [2, 3, 5]}, seed=[0, 1])])
    study.run()
    frame = study.frame()
    assert frame.groupby("set.n")["square"].max().to_dict() == {2: 4, 3: 9, 5: 25}
    assert (frame["finished"] >= frame["started"]).all()
    study.export("squares.csv")
    assert (folder / "squares.csv").read_text().count("\n") == 7
    assert study.report("page").read_text(encoding="utf-8").startswith("<!doctype html>")


# -- limits ----------------------------------------------------------------------------------------


def test_what_takes_too_much_is_stopped_and_the_rest_goes_on() -> None:
    study = Study("odd", [
        function("square", set={"n": [1, 2]}),
        function("hungry"),
        function("asleep"),
        function("hungry_children"),
        function("broken"),
        function("crashed"),
        function("left"),
        function("wordy"),
        function("no_such"),
        function("square", set={"m": 1}),
        function("square", set={"n": [3, 4]}),
    ], seconds=12, memory_bytes=230 * MIB, jobs=3)  # fmt: skip
    assert study.run(jobs=3).left == 0
    rows = study.rows()
    assert [row["status"] for row in rows] == [
        "ok", "ok", "memout", "timeout", "memout", *["error"] * 6, "ok", "ok",
    ]  # fmt: skip
    assert [row["square"] for row in rows if row["status"] == "ok"] == [1, 4, 9, 16]
    hungry, asleep, children, broken, crashed, left, wordy, missing, arguments = rows[2:11]
    for row in (hungry, children):
        assert row["peak_memory_bytes"] > 230 * MIB
        assert "the limit is 230 MiB" in row["message"]
    assert asleep["message"] == "stopped after 12 s"
    assert asleep["wall_seconds"] >= 12
    assert asleep["stage"] == "running"
    assert broken["message"] == "RuntimeError: it is <broken>"
    assert crashed["message"] == "ended by the signal SIGSEGV"
    assert left["message"] == "ended with the exit status 7 and without a result"
    assert "answered str" in wordy["message"]
    assert "no function no_such" in missing["message"]
    assert arguments["message"].startswith("TypeError")


def test_a_raised_limit_runs_again_what_had_met_it_and_nothing_else() -> None:
    grids = [function("square", set={"n": [1, 2]}), function("endless")]
    first = Study("again", grids, seconds=0.5)
    assert first.run().by_status == {"ok": 2, "timeout": 1, "memout": 0, "error": 0}
    before = first.rows()
    assert first.run() == first.counts()
    assert first.rows() == before
    Study("again", grids, seconds=1.0).run()
    after = first.rows()
    assert after[:2] == before[:2]
    assert (before[2]["time_limit_seconds"], after[2]["time_limit_seconds"]) == (0.5, 1.0)
    assert after[2]["wall_seconds"] >= 1.0
    first.run(retry=("ok",))
    assert first.rows()[0]["started"] > before[0]["started"]


@LINUX
def test_what_a_run_leaves_behind_is_killed(folder: Path) -> None:
    study = Study("left", [function("leaves_children", set={"started": str(folder / "pids")})])
    assert study.run().by_status["ok"] == 1
    processes = [int(line) for line in (folder / "pids").read_text().split()]
    assert len(processes) == 2
    until(lambda: all(map(gone, processes)))


# -- orphans ---------------------------------------------------------------------------------------

RUNNER = """
import sys
from factored_polca.studies import Study
Study("k", [{"work": "study_functions:asleep", "set": {"started": sys.argv[1]}}]).run()
"""


@LINUX
@pytest.mark.parametrize("victim", ["runner", "group", "warden"])
def test_a_run_does_not_outlive_what_supervises_it(folder: Path, victim: str) -> None:
    marker = folder / "pid"
    runner = subprocess.Popen(
        [sys.executable, "-c", RUNNER, str(marker)], start_new_session=True, stderr=subprocess.DEVNULL
    )
    try:
        until(lambda: marker.exists() and marker.read_text() != "")
        run = int(marker.read_text())
        (warden,) = descendants(runner.pid)[:1]
        assert run in descendants(runner.pid)
        if victim == "runner":
            os.kill(runner.pid, signal.SIGKILL)
        elif victim == "group":
            os.killpg(runner.pid, signal.SIGKILL)
        else:
            os.kill(warden, signal.SIGKILL)
        until(lambda: gone(run))
        if victim != "warden":
            until(lambda: gone(warden))
    finally:
        kill_tree(runner.pid)
        runner.wait()


@LINUX
def test_a_study_goes_on_when_its_warden_is_killed(folder: Path) -> None:
    before = set(limits.children(os.getpid()))
    study = Study("goes-on", [function("square", set={"n": list(range(40))})], jobs=2)
    killed: list[int] = []

    def kill_once(progress: Progress) -> None:
        if progress.here and not killed:
            (warden,) = set(limits.children(os.getpid())) - before
            os.kill(warden, signal.SIGKILL)
            killed.append(warden)

    assert study.run(progress=kill_once).by_status["ok"] == 40
    assert killed
    assert sorted(row["square"] for row in study.rows()) == [n * n for n in range(40)]


def test_a_run_whose_supervisor_is_always_lost_becomes_an_error() -> None:
    from concurrent.futures import Future

    from factored_polca.studies import Store, runner
    from factored_polca.studies.provenance import provenance

    study, calls = Study("lost", [function("square", set={"n": [1, 2]})]), []

    def start(request: Any) -> Any:
        calls.append(request["set"]["n"])
        future: Future[dict[str, Any]] = Future()
        future.set_exception(WorkerLost("gone"))
        return future

    with Store(study.store, writing=True) as store:
        launch = store.launch("lost", study.runs(), provenance() | {"arguments": []})
        runner.run_all(store, launch, study.runs(), study.limits, {}, start, 1)
        assert store.counts().by_status["error"] == 2
        assert "lost 3 times" in store.rows()[0]["message"]
    assert sorted(calls) == [1] * 3 + [2] * 3


def test_a_warden_that_cannot_start_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("factored_polca.studies.warden_client._START", "raise SystemExit('no way')")
    warden = Warden([])
    with pytest.raises(WorkerLost, match="no way"):
        warden.about()
    warden.close()


def test_a_tree_s_memory_is_the_sum_over_its_processes() -> None:
    program = (
        "import subprocess, sys; kept = b'x' * (60 << 20)\n"
        "if sys.argv[1:]: subprocess.Popen([sys.executable, '-c', sys.argv[1]])\n"
        "print('ready', flush=True); import time; time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, program], stdout=subprocess.PIPE, start_new_session=True
    )
    try:
        assert process.stdout is not None
        for _ in range(2):
            assert process.stdout.readline() == b"ready\n"
        (child,) = descendants(process.pid)
        both = [resident_bytes(process.pid), resident_bytes(child)]
        assert all(60 * MIB < one < 120 * MIB for one in both)
        assert tree_bytes(process.pid) == pytest.approx(sum(both), rel=0.02)
    finally:
        kill_tree(process.pid)
        process.wait()
    assert descendants(process.pid) == []


def test_trees_are_found_without_proc_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """By `ps`: the same processes, and nearly the same sizes."""
    program = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"
    process = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE)
    try:
        until(lambda: len(limits.descendants(process.pid)) == 1)
        until(lambda: limits.tree_bytes(process.pid) > 15 * MIB)
        time.sleep(0.2)
        ours = limits.children(os.getpid()), limits.descendants(process.pid)
        taken = limits.tree_bytes(process.pid)
        monkeypatch.setattr(limits, "BY_CHILDREN", False)
        assert (limits.children(os.getpid()), limits.descendants(process.pid)) == ours
        assert limits.tree_bytes(process.pid) == pytest.approx(taken, rel=0.1)
        assert limits.resident_bytes(process.pid) < taken
    finally:
        limits.kill_tree(process.pid)
        process.wait()
    assert limits.descendants(process.pid) == []


def test_runs_that_start_a_new_python_give_the_same() -> None:
    def request(work: str, **arguments: Any) -> dict[str, Any]:
        return {
            "work": f"study_functions:{work}", "set": arguments, "seed": 0, "text": None,
            "limits": {"seconds": 6, "memory_bytes": 200 * MIB},
        }  # fmt: skip

    warden = Warden([], fork=False)
    assert warden.about()["forks"] is False
    futures = [warden.start(request(name, **given)) for name, given in (
        ("square", {"n": 7}), ("hungry", {}), ("asleep", {}), ("broken", {}), ("left", {})
    )]  # fmt: skip
    outcomes = [future.result() for future in futures]
    warden.close()
    assert [one["status"] for one in outcomes] == ["ok", "memout", "timeout", "error", "error"]
    assert outcomes[0]["figures"]["square"] == 49
    assert "it is <broken>" in outcomes[3]["detail"]


# -- elsewhere -------------------------------------------------------------------------------------

SAME = [
    {"work": "minimise", "model": "linear", "set": {"size": [4, 5]}, "seed": [0, 1]},
    {"work": "solve", "model": "tiger", "solver": ["sarsop", "qmdp"], "gap": 0.01},
    function("square", set={"n": list(range(6))}),
    function("hungry"),
    function("broken"),
]


def table(study: Study) -> list[dict[str, Any]]:
    """The results without what depends on time and place."""
    return [
        {
            name: value
            for name, value in row.items()
            if not name.endswith(("seconds", "_bytes")) and name not in ("started", "finished")
            and not (name == "message" and row["status"] == "memout")
        }
        for row in study.rows()
    ]  # fmt: skip


def same(name: str, **more: Any) -> Study:
    return Study(name, SAME, seconds=60, memory_bytes=400 * MIB, **more)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """The table of the study, run by this process's own warden."""
    study = same("local", store=tmp_path_factory.mktemp("local") / "local.sqlite")
    counts = study.run(jobs=2)
    assert counts.by_status == {"ok": 12, "timeout": 0, "memout": 1, "error": 1}
    return table(study)


@pytest.mark.parametrize(("kind", "workers"), [(ThreadPoolExecutor, 2), (ProcessPoolExecutor, 1)])
def test_an_executor_gives_the_same_table(local: list[dict[str, Any]], kind: Any, workers: int) -> None:
    study = same("elsewhere")
    with kind(workers) as executor:
        study.run(executor=executor, jobs=4)
    assert table(study) == local


def test_parsl_with_two_workers_gives_the_same_table(local: list[dict[str, Any]]) -> None:
    pytest.importorskip("parsl")
    study = same("cluster", cluster=Cluster(workers=2))
    study.run()
    assert table(study) == local


def test_an_executor_that_breaks_down_stops_the_study_and_keeps_what_is_done() -> None:
    study = Study("breaks", [function("square", set={"n": list(range(8))})])
    executor = ProcessPoolExecutor(1)
    with executor:
        executor.submit(os.getpid).result()
        executor.submit(os._exit, 1)
        with pytest.raises(WorkerLost, match="broken down"):
            study.run(executor=executor, jobs=1)
    assert study.run().by_status["ok"] == 8


def test_configurations_of_parsl_are_made_for_each_provider(tmp_path: Path) -> None:
    pytest.importorskip("parsl")
    from factored_polca.studies.cluster import make_config

    local = make_config(Cluster(workers=3, nodes=2), str(tmp_path)).executors[0]
    assert (local.max_workers_per_node, local.provider.init_blocks, local.address) == (3, 2, "127.0.0.1")
    slurm = make_config(
        Cluster("slurm", workers=8, nodes=4, partition="short", walltime="02:00:00"), str(tmp_path)
    ).executors[0]
    assert (slurm.provider.partition, slurm.provider.nodes_per_block) == ("short", 4)
    assert slurm.provider.walltime == "02:00:00"
    assert Cluster("slurm", workers=8, nodes=4).slots == 64


@LINUX
def test_runs_on_this_machine_end_with_the_process_that_wanted_them(folder: Path) -> None:
    """As where Parsl's workers outlive a killed runner: the warden is another process's child."""
    marker = folder / "pid"
    client = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    request = {
        "work": "study_functions:asleep", "set": {"started": str(marker)}, "seed": 0, "text": None,
        "limits": {"seconds": None, "memory_bytes": None},
    }  # fmt: skip
    with ThreadPoolExecutor(1) as executor:
        future = executor.submit(run_here, request, [], this_client() | {"process": client.pid})
        until(lambda: marker.exists() and marker.read_text() != "")
        client.kill()
        client.wait()
        with pytest.raises(WorkerLost):
            future.result(timeout=30)
    until(lambda: gone(int(marker.read_text())))


# -- killed again and again ------------------------------------------------------------------------


@LINUX
def test_a_study_that_is_killed_goes_on_to_one_result_for_each_run(folder: Path) -> None:
    """A short form of `tests/benchmarks/study_kills.py`."""
    text = '[[grid]]\nwork = "study_functions:unhurried"\nset.n = "0..39"\n'
    found = rehearse(text, 40, 4, seed=3, folder=folder)
    assert len(found.after_kills) >= 2  # of 4: a quick machine is done before the last ones
    assert sum(found.by_launch) == 40
