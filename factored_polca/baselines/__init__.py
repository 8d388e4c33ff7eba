"""Learners to compare PolCA with: they sample a model's steps instead of planning on it.

One algorithm a file: flat Q-learning (`q_learning`), hierarchical semi-Markov Q-learning (`hsmq`), MAXQ-Q
(`maxq`), the three-part decomposition of ALisp (`alisp`) and options (`options`).  They share the
process that they sample (`process`), the task graph (`task_graph`), tables of stored values (`tables`)
and the loop over episodes (`learning`).  `taxi` holds the task graphs and hand-made abstractions of
Taxi, and `return_of_greedy` the exact value of what was learned.

    from factored_polca import load_domain
    from factored_polca.baselines import Schedule, learn, sampled_process, taxi_facts, taxi_methods

    model = load_domain("taxi", {"discount": 1}).model
    process = sampled_process(model)
    for method in taxi_methods(taxi_facts(process)):
        learned = learn(method, process, Schedule(episodes=20_000), seed=0)
        print(method.name, method.stored_values, learned.visited, learned.greedy_returns[-1])
"""

from __future__ import annotations

from factored_polca.baselines.learning import Learned, Method, Schedule, learn
from factored_polca.baselines.process import SampledProcess, sampled_process
from factored_polca.baselines.return_of_greedy import return_of_greedy
from factored_polca.baselines.tables import Table
from factored_polca.baselines.task_graph import TaskGraph
from factored_polca.baselines.taxi import TaxiFacts, taxi_facts
from factored_polca.baselines.taxi_methods import taxi_methods

__all__ = [
    "Learned",
    "Method",
    "SampledProcess",
    "Schedule",
    "Table",
    "TaskGraph",
    "TaxiFacts",
    "learn",
    "return_of_greedy",
    "sampled_process",
    "taxi_facts",
    "taxi_methods",
]
