"""Minimise a PRISM program with an engine of Storm's and print one JSON object.

    python -m factored_polca.bench.storm_run '{"path": FILE, "engine": "sparse" or "dd"}'

    sparse   explores reachable states; action-sensitive bisimulation, all rewards kept, in doubles
    dd       Sylvan, one worker; bisimulation that does not tell actions by their names

Seconds are the processor's, of building the model and of minimising it, without starting and parsing.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

from factored_polca.bench.memory import peak_bytes


def run(path: str, engine: str) -> dict[str, Any]:
    """Build and minimise."""
    import stormpy

    program = stormpy.parse_prism_program(path)
    began = time.process_time()
    if engine == "dd":
        properties = stormpy.parse_properties('R{"reward"}max=? [ C ]', program)
        model = stormpy.build_symbolic_model[float](program, properties)
        quotient = stormpy.transformations.perform_bisimulation(model, properties)
    else:
        options = stormpy.BuilderOptions()
        options.set_build_all_reward_models()
        options.set_build_choice_labels()
        model = stormpy.build_model[float](program, options=options)
        wanted = stormpy.transformations.BisimulationOptions()
        wanted.action_sensitive = True
        wanted.preserve_all_rewards = True
        wanted.state_label_preservation = stormpy.transformations.StateLabelPreservation.NONE
        quotient = stormpy.transformations.perform_bisimulation(model, [], options=wanted)
    seconds = time.process_time() - began
    return {"blocks": quotient.nr_states, "seconds": seconds, "memory": peak_bytes()}


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print()
    print(json.dumps(run(given["path"], given["engine"])))
