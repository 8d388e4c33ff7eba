"""Run one case in this process and print one JSON object: `python -m factored_polca.bench.one_run`.

seconds        the processor's, of compiling the model to diagrams and minimising it; kernels loaded,
               nothing else warm: the first minimisation of the process
compile        of that, making the diagrams from the model
kernels        loading the kernels from disk, or compiling them where they have not been before
nodes          diagram nodes made
memory         the largest resident set of the process, in bytes, Python and its libraries included
before         the same before the model was read
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping
from typing import Any

from factored_polca import library
from factored_polca.bench.dyadic import dyadic
from factored_polca.bench.memory import peak_bytes
from factored_polca.hierarchy.warm import warm_up
from factored_polca.minimisation import flat_process, minimise
from factored_polca.models import Model
from factored_polca.symbolic import compile_model


def model_of(domain: str, settings: Mapping[str, str], denominator: int | None) -> Model:
    """A shipped domain, its probabilities dyadic where there is a `denominator`."""
    model = library.load(domain, dict(settings)).model
    return model if denominator is None else dyadic(model, denominator)


def run(
    domain: str, settings: Mapping[str, str], denominator: int | None, interchangeable: bool
) -> dict[str, Any]:
    """Minimise one domain and say what it took."""
    began = time.process_time()
    warm_up()
    warmed = time.process_time()
    before = peak_bytes()
    model = model_of(domain, settings, denominator)
    loaded = time.process_time()
    symbolic = compile_model(model)
    compiled = time.process_time()
    found = minimise(flat_process(symbolic), interchangeable=interchangeable)
    done = time.process_time()
    return {
        "states": str(model.states),
        "blocks": found.partition.blocks,
        "actions": len(model.actions),
        "rounds": found.rounds,
        "seconds": done - loaded,
        "compile": compiled - loaded,
        "kernels": warmed - began,
        "nodes": symbolic.manager.nodes_made,
        "memory": peak_bytes(),
        "before": before,
    }


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(json.dumps(run(**given)))
