"""Solving on diagrams, without a quotient: value iteration, and point-based POMDP value iteration."""
