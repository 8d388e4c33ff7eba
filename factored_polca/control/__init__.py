"""Execution of plans: the polling controller."""

from factored_polca.control.controller import Controller, Decision, Poll

__all__ = ["Controller", "Decision", "Poll"]
