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
from typing import Any

from factored_polca import library
from factored_polca.bench.memory import peak_bytes
from factored_polca.hierarchy.warm import warm_up
from factored_polca.minimisation import flat_process, minimise
from factored_polca.symbolic import compile_model


def run(domain: str, settings: dict[str, str], interchangeable: bool) -> dict[str, Any]:
    """Minimise one domain and say what it took."""
    began = time.process_time()
    warm_up()
    warmed = time.process_time()
    before = peak_bytes()
    model = library.load(domain, settings).model
    loaded = time.process_time()
    symbolic = compile_model(model)
    compiled = time.process_time()
    found = minimise(flat_process(symbolic), interchangeable=interchangeable)
    done = time.process_time()
    return {
        "states": str(model.states),
        "blocks": found.partition.blocks,
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
    print(json.dumps(run(given["domain"], given["settings"], given["interchangeable"])))
