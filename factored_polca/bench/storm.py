"""Storm as a peer (Hensel, Junges, Katoen, Quatmann & Volk 2022): its bisimulations on the same models.

Storm reads the PRISM program that `factored_polca.formats.prism_writer` makes of a model, started in every
state, as we count them all.
"""

from __future__ import annotations

import importlib.util
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from factored_polca.bench.cases import Case
from factored_polca.bench.one_run import model_of
from factored_polca.bench.runner import Peer, PeerRow, reason, run_process
from factored_polca.formats.prism_writer import write_prism
from factored_polca.models import ModelError
from factored_polca.models.model import InitialBelief, replace_fields


def storm_peers() -> list[Peer]:
    """Storm, where stormpy is installed."""
    return [storm] if importlib.util.find_spec("stormpy") is not None else []


def storm(case: Case, seconds: float) -> Sequence[PeerRow]:
    """Both engines, those that the case is for."""
    names = [f"Storm {engine}" for engine in case.engines]
    try:
        model = model_of(case.domain, case.settings, case.denominator)
        text = write_prism(replace_fields(model, initial=InitialBelief()))
    except (ModelError, ValueError) as error:
        return [PeerRow(name, None, None, None, str(error)) for name in names]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.prism"
        path.write_text(text, encoding="utf-8")
        for name, engine in zip(names, case.engines, strict=True):
            given = {"path": str(path), "engine": engine}
            try:
                found = run_process(["factored_polca.bench.storm_run"], given, seconds)
            except (subprocess.SubprocessError, ValueError) as error:
                rows.append(PeerRow(name, None, None, None, reason(error)))
                continue
            rows.append(PeerRow(name, found["blocks"], found["seconds"], found["memory"]))
    return rows
