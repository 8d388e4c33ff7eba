"""The model as numbered states: plain, slow and exact, the oracle of the tests; and arrays for solvers.

Knows `factored_polca.models` only, nothing of decision diagrams.
"""
