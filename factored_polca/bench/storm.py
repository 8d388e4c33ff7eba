"""Storm as a peer (Hensel, Junges, Katoen, Quatmann & Volk 2022): its bisimulations on the same models.

Storm reads the PRISM program that `factored_polca.formats.prism_writer` makes of a model, started in every
state, as we count them all.  Its sparse engine counts one block more: the state before the start.
"""

from __future__ import annotations

import importlib.util
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from factored_polca import library
from factored_polca.bench.cases import Case
from factored_polca.bench.dyadic import dyadic
from factored_polca.bench.one_start import started_by_an_action
from factored_polca.bench.runner import Peer, PeerRow, reason, run_process
from factored_polca.formats.prism_writer import write_prism
from factored_polca.models import ModelError
from factored_polca.models.model import InitialBelief, replace_fields


def storm_peers() -> list[Peer]:
    """Storm, where stormpy is installed."""
    return [storm] if importlib.util.find_spec("stormpy") is not None else []


def storm(case: Case, seconds: float) -> Sequence[PeerRow]:
    """The engines that the case is for."""
    return [with_engine(case, engine, seconds) for engine in case.engines]


def with_engine(case: Case, engine: str, seconds: float) -> PeerRow:
    """One engine; the sparse one, which lists the states of a start, gets one action that leads to all."""
    name = f"Storm {engine}"
    try:
        model = library.load(case.domain, dict(case.settings)).model
        if engine == "sparse":
            model = started_by_an_action(model)
        else:
            model = replace_fields(model, initial=InitialBelief())
        if case.denominator is not None:
            model = dyadic(model, case.denominator)
        text = write_prism(model)
    except (ModelError, ValueError) as error:
        return PeerRow(name, None, None, None, str(error))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.prism"
        path.write_text(text, encoding="utf-8")
        given = {"path": str(path), "engine": engine}
        try:
            found = run_process(["factored_polca.bench.storm_run"], given, seconds)
        except (subprocess.SubprocessError, ValueError) as error:
            return PeerRow(name, None, None, None, reason(error))
    return PeerRow(name, found["blocks"], found["seconds"], found["memory"])
