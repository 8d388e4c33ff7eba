"""The layers of the package, as README.md draws them, and habits that hold in every module.

`MAY_IMPORT` is the table: a layer is a folder of `factored_polca` or a module beside them, and may
import from itself and from the layers listed.  Imports inside a method called `_repr_*` or `to_*`
are exempt: objects may draw or convert themselves with what lies above them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "factored_polca"

MODELS = {"models", "drawn"}
SYMBOLIC = {"symbolic", "diagrams", *MODELS}
MINIMISATION = {"minimisation", "explicit", *SYMBOLIC}
SOLVING = {"solvers", *MINIMISATION}
HIERARCHY = {"hierarchy", "approximation", "structured", "formats", *SOLVING}
CONTROL = {"control", "hierarchy", *MINIMISATION}

MAY_IMPORT: dict[str, set[str]] = {
    "drawn": set(),  # methods that call `display` when something is to be drawn
    "models": {"drawn"},
    "diagrams": {"drawn"},
    "library": MODELS,
    "symbolic": {"diagrams", *MODELS},
    "explicit": MODELS,
    "formats": {"explicit", *MODELS},
    "minimisation": MINIMISATION,
    "solvers": {"explicit", *MODELS},
    "approximation": SOLVING,
    "structured": SOLVING,
    "parametric": SOLVING,
    "hierarchy": HIERARCHY,  # plan files hold the model in the native format
    "control": CONTROL,
    "simulation": {"control", "hierarchy", "explicit", *SYMBOLIC},  # what it runs is a hierarchy's plan
    # what it adapts: solvers and files of POMDPs; for Gymnasium models, and sampling from them
    "external": {"simulation", "solvers", "formats", "explicit", *SYMBOLIC},
    # the kit for other packages' tests reads everything that it checks
    "testing": {"simulation", "control", *HIERARCHY},
    "studies": {"parametric", "display", "baselines", "simulation", "control", "library", *HIERARCHY},
    "baselines": {"simulation", "control", *HIERARCHY},
    "display": {"parametric", "simulation", "control", "library", *HIERARCHY},
    # what runs other models, whole programs and peers, and draws what came of it
    "bench": {
        "parametric",
        "studies",
        "external",
        "display",
        "baselines",
        "simulation",
        "control",
        "library",
        *HIERARCHY,
    },
    # from the top package: the version
    "cli": {
        "bench",
        "studies",
        "display",
        "parametric",
        "baselines",
        "simulation",
        "control",
        "library",
        "",
        *HIERARCHY,
    },
    "__main__": {"cli"},
}

FORBIDDEN_CALLS = {"eval", "exec", "compile", "sympify", "parse_expr", "lambdify", "__import__"}
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "marshal", "shelve", "yaml", "ruamel"}
LONGEST_MODULE = 450

LONGER_MODULES = {
    "formats/native_reader.py",  # one table of keys, each with its reader
    "models/expressions.py",  # the kinds of expressions and their operators, one algebra
}


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def named(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def layer_of(path: Path) -> str:
    """The folder under the package, or the module beside the folders; "" is the top package."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return "" if parts == ("__init__",) else parts[0]


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def imports(path: Path) -> Iterator[tuple[str, tuple[str, ...], bool]]:
    """The imports in a file as (module, names, inside a `_repr_*` or `to_*` method)."""
    stack: list[tuple[ast.AST, bool]] = [(tree(path), False)]
    while stack:
        node, exempt = stack.pop()
        if isinstance(node, ast.FunctionDef) and node.name.startswith(("_repr_", "to_")):
            exempt = True
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, (), exempt
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{named(path)}: imports name the package in full"
            yield node.module or "", tuple(alias.name for alias in node.names), exempt
        stack += [(child, exempt) for child in ast.iter_child_nodes(node)]


def layers_imported(path: Path) -> Iterator[tuple[str, str]]:
    """The layers that a file imports from, exempt imports left out, each with the module's name."""
    for module, names, exempt in imports(path):
        parts = module.split(".")
        if parts[0] != "factored_polca" or exempt:
            continue
        if len(parts) > 1:
            yield parts[1], module
        for name in names if len(parts) == 1 else ():
            yield (name if name in MAY_IMPORT else ""), module


def test_every_layer_has_a_row_in_the_table() -> None:
    found = {layer_of(path) for path in modules()} - {""}
    assert found <= set(MAY_IMPORT), f"no row for {found - set(MAY_IMPORT)}"


def test_the_table_has_no_cycles() -> None:
    done: set[str] = set()
    left = dict(MAY_IMPORT)
    while left:
        ready = [layer for layer, below in left.items() if below - {layer, ""} <= done]
        assert ready, f"a cycle among {sorted(left)}"
        done.update(ready)
        for layer in ready:
            del left[layer]


@pytest.mark.parametrize("path", modules(), ids=named)
def test_a_module_imports_only_from_layers_below_its_own(path: Path) -> None:
    layer = layer_of(path)
    if layer == "":
        return  # the top package offers everything, lazily; test_package.py holds that
    allowed = MAY_IMPORT[layer] | {layer}
    wrong = sorted({f"{module}" for below, module in layers_imported(path) if below not in allowed})
    assert not wrong, f"{named(path)} imports {wrong}; {layer} may import {sorted(allowed)}"


@pytest.mark.parametrize("path", modules(), ids=named)
def test_no_private_name_crosses_layers(path: Path) -> None:
    for module, names, _ in imports(path):
        parts = module.split(".")
        if parts[0] == "factored_polca" and parts[1:2] != [layer_of(path)]:
            private = [name for name in (*parts, *names) if name.startswith("_") and name != "__version__"]
            assert not private, f"{named(path)} imports {private} from {module}"


@pytest.mark.parametrize("path", modules(), ids=named)
def test_no_module_runs_text_or_unpickles(path: Path) -> None:
    for module, names, _ in imports(path):
        wrong = {module.partition(".")[0]} & FORBIDDEN_MODULES | set(names) & FORBIDDEN_CALLS
        assert not wrong, f"{named(path)} imports {wrong}"
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            assert node.func.id not in FORBIDDEN_CALLS, f"{named(path)}:{node.lineno}"
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            # `re.compile` is another thing than the built-in function
            function = node.func.attr
            assert function not in FORBIDDEN_CALLS - {"compile"}, f"{named(path)}:{node.lineno}"
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert isinstance(node.value, ast.Constant), f"{named(path)}:{node.value.lineno}"
            assert node.value.value is False, f"{named(path)}:{node.value.lineno}"


@pytest.mark.parametrize("path", modules(), ids=named)
def test_every_module_says_what_it_is(path: Path) -> None:
    assert ast.get_docstring(tree(path)), f"{named(path)} has no docstring"


def test_modules_are_short() -> None:
    lengths = {named(path): len(path.read_text(encoding="utf-8").splitlines()) for path in modules()}
    long = {name for name, lines in lengths.items() if lines > LONGEST_MODULE}
    assert long <= LONGER_MODULES, f"split {sorted(long - LONGER_MODULES)}"
    assert long >= LONGER_MODULES, f"no exceptions any more: {sorted(LONGER_MODULES - long)}"


def test_the_domains_know_the_models_and_the_library_only() -> None:
    for path in sorted((ROOT / "domains").glob("*.py")):
        nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        sources = [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]
        below = {source.split(".")[1] for source in sources if source.startswith("factored_polca.")}
        assert below <= {"models", "library"}, path.name
