"""Policy files of alpha-vectors as diagrams, as `solve --solver symbolic` finds them, with their model.

One zip (`factored_polca.formats.archive`):

    alphas.json     "format", "version", "order" (the features from the top of the diagrams down) and
                    "report" (what the solver said)
    model.toml      the model in the native format
    actions.npy     the number of each alpha-vector's action
    seen.npy        its values of the observed features, -1 where it is of the whole state
    sizes.npy       its numbers of nodes, of children and of leaves
    levels.npy, children.npy, leaves.npy    its diagrams, one after the other, as `diagrams.dump` has them

No state is listed when it is read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram, dump, load, support
from factored_polca.formats import read_native, write_native
from factored_polca.formats.archive import Archive, is_archive_with, reading, write_archive
from factored_polca.models import Model
from factored_polca.structured.pomdp_lower import Alpha
from factored_polca.structured.pomdp_model import Seen
from factored_polca.structured.pomdp_solution import AlphaDiagrams
from factored_polca.symbolic import SymbolicModel, compile_model

FORMAT: Final = "factored-polca alpha-vectors as diagrams"
VERSION: Final = 1
HEAD: Final = "alphas.json"


@dataclass(frozen=True)
class AlphaPolicy:
    """A policy of alpha-vectors as diagrams, and what was said when it was made."""

    policy: AlphaDiagrams
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> Model:
        """The model."""
        return self.policy.symbolic.model


def save_alpha_policy(policy: AlphaDiagrams, path: str | Path, report: Mapping[str, Any]) -> None:
    """Write a policy file; it appears whole or not at all.

    Raises:
        ModelError: no such folder, or a device or folder in the file's place.
        OSError: the file can't be written.
    """
    symbolic, arrays = policy.symbolic, alpha_arrays(policy)
    head = {"format": FORMAT, "version": VERSION, "order": list(symbolic.order), "report": dict(report)}
    texts = {
        HEAD: json.dumps(head, indent=1, allow_nan=False),
        "model.toml": write_native(symbolic.model, None),
    }
    write_archive(path, texts, arrays)


def is_alpha_policy_file(path: str | Path) -> bool:
    """Whether `path` looks like such a policy file."""
    return is_archive_with(path, HEAD)


def load_alpha_policy(path: str | Path, *, memory_limit: int | None = None) -> AlphaPolicy:
    """Read a policy file.

    Raises:
        ModelError: no such file, no policy, or damaged; the message names the file.
    """
    hint = f"make one with solve MODEL --solver symbolic -o {Path(path).name}"
    with reading(path, "policy file", hint) as archive:
        head = archive.json(HEAD)
        if head.get("format") != FORMAT:
            raise ValueError("no policy of this program")
        if head.get("version") != VERSION:
            raise ValueError(
                f"policy version {str(head.get('version'))[:20]}; this program reads {VERSION}"
            )
        model = read_native(archive.text("model.toml")).model
        order = head.get("order")
        names = sorted(feature.name for feature in model.features)
        if not isinstance(order, list) or sorted(map(str, order)) != names:
            raise ValueError("its order is not one of its model's features")
        report = head.get("report")
        if not isinstance(report, dict):
            raise ValueError("its report is no object")
        symbolic = compile_model(model, order=order, memory_limit=memory_limit)
        policy = read_alphas(archive, symbolic, len(model.actions))
    return AlphaPolicy(policy, report)


def alpha_arrays(policy: AlphaDiagrams) -> dict[str, npt.NDArray[Any]]:
    """The alpha-vectors of a policy as arrays; see the module's docstring."""
    count = len(policy.space.pomdp.observed)
    entries: list[tuple[int, Seen, Diagram]] = [(a, (-1,) * count, d) for a, d in policy.blind]
    entries += [(x.action, y, x.diagram) for y, alphas in policy.slices.items() for x in alphas]
    dumps = [dump(diagram) for _, _, diagram in entries]
    sizes = [[len(d["levels"]), len(d["children"]), len(d["leaves"])] for d in dumps]
    return {
        "actions": np.array([action for action, _, _ in entries], dtype=np.int64),
        "seen": np.array([y for _, y, _ in entries], dtype=np.int64).reshape(len(entries), count),
        "sizes": np.array(sizes, dtype=np.int64).reshape(len(entries), 3),
        "levels": np.concatenate([d["levels"] for d in dumps]).astype(np.int64),
        "children": np.concatenate([d["children"] for d in dumps]).astype(np.int64),
        "leaves": np.concatenate([d["leaves"] for d in dumps]).view(np.float64),
    }


def read_alphas(archive: Archive, symbolic: SymbolicModel, count: int) -> AlphaDiagrams:
    """The policy of `alpha_arrays`, its actions being fewer than `count`.

    Raises:
        ValueError: it is damaged.
    """
    actions, seen = archive.array("actions", "integers"), archive.array("seen", "integers", 2)
    sizes = archive.array("sizes", "integers", 2)
    parts = [archive.array(name, "integers") for name in ("levels", "children")]
    parts.append(archive.array("leaves", "numbers"))
    model = symbolic.model
    observed = [i for i, f in enumerate(model.features) if f.observed]
    hidden = {2 * symbolic.positions[i] for i in range(len(model.features))}
    if seen.shape != (len(actions), len(observed)) or sizes.shape != (len(actions), 3):
        raise ValueError("its arrays do not fit together")
    if len(actions) == 0 or actions.min() < 0 or actions.max() >= count:
        raise ValueError("an alpha-vector has no action of the model")
    ends = np.cumsum(sizes, axis=0)
    if sizes.min() < 0 or any(ends[-1, i] != len(part) for i, part in enumerate(parts)):
        raise ValueError("its diagrams do not fit together")
    blind: list[tuple[int, Diagram]] = []
    slices: dict[Seen, list[Alpha]] = {}
    for number, action in enumerate(actions.tolist()):
        begin, end = ends[number] - sizes[number], ends[number]
        names_of = ("levels", "children", "leaves")
        piece = {n: p[b:e] for n, p, b, e in zip(names_of, parts, begin, end, strict=True)}
        piece["leaves"] = piece["leaves"].view(np.int64)
        diagram = load(symbolic.manager, piece, FLOAT)
        if not set(support(diagram)) <= hidden:
            raise ValueError("a diagram is of other variables than the features")
        y: Seen = tuple(int(v) for v in seen[number])
        if all(v == -1 for v in y) and (y or not blind):
            blind.append((action, diagram))
        elif all(0 <= v < len(model.features[i].values) for i, v in zip(observed, y, strict=True)):
            slices.setdefault(y, []).append(Alpha(y, action, diagram))
        else:
            raise ValueError("an alpha-vector is of values that are not to be seen")
    if not blind:
        raise ValueError("no alpha-vector is of the whole state")
    return AlphaDiagrams(symbolic, tuple(blind), {y: tuple(a) for y, a in slices.items()})
