"""The package as a whole: lazy public names, version, files that tools need."""

from __future__ import annotations

import ast
import importlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import factored_polca

ROOT = Path(__file__).resolve().parent.parent


def child(code: str) -> str:
    """What a fresh Python process prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_importing_the_package_loads_no_library() -> None:
    code = "import sys, json, factored_polca; print(json.dumps(sorted(sys.modules)))"
    loaded = {name.partition(".")[0] for name in json.loads(child(code))}
    assert "factored_polca" in loaded
    assert not loaded & {"numba", "sympy", "dd", "scipy", "numpy", "networkx", "rich"}


def test_describing_a_model_loads_neither_kernels_nor_solvers() -> None:
    code = (
        "import sys, json, factored_polca as fp; "
        "fp.Model('m', [fp.boolean('x')], [fp.Action('a', {'x': 'not x'})]); "
        "print(json.dumps(sorted(sys.modules)))"
    )
    loaded = {name.partition(".")[0] for name in json.loads(child(code))}
    assert not loaded & {"numba", "sympy", "dd", "scipy"}


@pytest.mark.parametrize("name", factored_polca.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert name in dir(factored_polca)
    assert getattr(factored_polca, name) is not None


def test_a_public_name_is_the_thing_of_its_layer() -> None:
    for module, names in factored_polca._HOME.items():
        home = importlib.import_module(f"factored_polca.{module}")
        for name in names:
            assert getattr(factored_polca, name) is getattr(home, "load" if name == "load_domain" else name)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'no_such_name'"):
        factored_polca.no_such_name  # noqa: B018


def test_type_checkers_see_the_names_that_are_loaded_lazily() -> None:
    tree = ast.parse((ROOT / "factored_polca" / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        (alias.asname or alias.name, (node.module or "").removeprefix("factored_polca."))
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == {(name, module) for module, names in factored_polca._HOME.items() for name in names}
    assert {name for name, _ in seen} | {"__version__"} == set(factored_polca.__all__)
    assert (ROOT / "factored_polca" / "py.typed").is_file()


def test_the_version_is_the_same_everywhere() -> None:
    version = factored_polca.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert project["tool"]["hatch"]["version"]["path"] == "factored_polca/__init__.py"
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert next(line for line in changelog.splitlines() if line.startswith("## ")) == f"## {version}"


def test_the_wheel_carries_the_domains_inside_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    assert wheel["packages"] == ["factored_polca"]
    assert wheel["force-include"] == {"domains": "factored_polca/domains"}


def test_continuous_integration_ends_with_the_test_command_of_the_readme() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111
    text = script.read_text(encoding="utf-8")
    assert "set -euo pipefail" in text
    assert text.rstrip().splitlines()[-1].startswith("eval ")
    order = [text.index(step) for step in ('ruff" check', "format --check", 'mypy" --strict', "eval ")]
    assert order == sorted(order)
