"""Fuzzing of every reader of files: `python -m tests.fuzz` (see `tests/fuzz/__main__.py`).

An input is a function of a short string of bytes, its *choices* (`choices.Choices`): hypothesis finds and
shrinks such strings in the tests, the command draws them from a seeded generator.
"""
