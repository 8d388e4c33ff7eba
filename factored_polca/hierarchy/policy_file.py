"""Policy files: a policy without a hierarchy, as `solve` finds it, with the model that it is for.

One zip (`factored_polca.formats.archive`):

    policy.json    "format", "version", "kind" (alpha, staged, graph, entropy or mdp), "reachable" (which
                   states are numbered), "states" (how many), "digest" (of the list of states), "head"
                   (what the kind needs besides arrays) and "report" (what the solver said)
    model.toml     the model in the native format
    NAME.npy       the arrays of the policy, see `factored_polca.formats.policy_arrays`

Policies speak of states by their numbers.  Reading a file lists the states of its model again; the
digest says whether they are the same.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from factored_polca.drawn import DrawnGraph
from factored_polca.explicit.policies import AnyPolicy, horizon_of
from factored_polca.formats import read_native, write_native
from factored_polca.formats.archive import is_archive_with, reading, write_archive
from factored_polca.formats.policy_arrays import read_policy, stored_policy
from factored_polca.minimisation.flat_model import FlatModel, flat_model
from factored_polca.models import Model, ModelError
from factored_polca.symbolic import compile_model

FORMAT: Final = "factored-polca policy"
VERSION: Final = 1
HEAD: Final = "policy.json"


@dataclass(frozen=True)
class FlatPolicy(DrawnGraph):
    """A policy, the arrays that it is for, and what was said when it was made."""

    flat: FlatModel
    policy: AnyPolicy
    report: Mapping[str, Any] = field(default_factory=dict)

    @property
    def model(self) -> Model:
        """The model."""
        return self.flat.symbolic.model


def save_policy(policy: FlatPolicy, path: str | Path) -> None:
    """Write a policy file; it appears whole or not at all.

    Raises:
        ModelError: no such folder, or a device or folder in the file's place.
        OSError: the file can't be written.
        ValueError: a report that JSON can't hold.
    """
    stored = stored_policy(policy.policy)
    head = {
        "format": FORMAT,
        "version": VERSION,
        "kind": stored.kind,
        "reachable": policy.flat.reachable,
        "states": len(policy.flat.states),
        "digest": policy.flat.digest(),
        "head": dict(stored.head),
        "report": dict(policy.report),
    }
    texts = {
        HEAD: json.dumps(head, indent=1, allow_nan=False),
        "model.toml": write_native(policy.model, None),
    }
    write_archive(path, texts, stored.arrays)


def is_policy_file(path: str | Path) -> bool:
    """Whether `path` looks like a policy file rather than a plan or something else."""
    return is_archive_with(path, HEAD)


def load_policy(path: str | Path, *, memory_limit: int | None = None) -> FlatPolicy:
    """Read a policy file and list the states of its model.

    Raises:
        ModelError: no such file, no policy, or damaged; the message names the file.
        LimitReached: the model has too many states.
    """
    hint = f"make one with solve MODEL -o {Path(path).name}"
    with reading(path, "policy file", hint) as archive:
        head = archive.json(HEAD)
        _check_head(head)
        model = read_native(archive.text("model.toml")).model
    try:
        flat = flat_model(compile_model(model, memory_limit=memory_limit), reachable=head["reachable"])
    except ModelError as error:
        raise error.in_file(str(path)) from None
    with reading(path, "policy file", hint) as archive:
        if head["states"] != len(flat.states) or head["digest"] != flat.digest():
            raise ValueError("its states are not those of its model")
        policy = read_policy(head["kind"], head["head"], archive, flat.pomdp)
        if horizon_of(policy) != model.horizon:
            raise ValueError("the policy and its model have different horizons")
    return FlatPolicy(flat, policy, head["report"])


def _check_head(head: Mapping[str, Any]) -> None:
    if head.get("format") != FORMAT:
        raise ValueError("no policy of this program")
    if head.get("version") != VERSION:
        raise ValueError(f"policy version {str(head.get('version'))[:20]}; this program reads {VERSION}")
    kinds = {"kind": str, "reachable": bool, "states": int, "digest": str, "head": dict, "report": dict}
    wrong = [name for name, kind in kinds.items() if not isinstance(head.get(name), kind)]
    if wrong:
        raise ValueError(f"{wrong[0]} in {HEAD} is missing or not what it should be")
