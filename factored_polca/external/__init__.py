"""Other people's programs and libraries: environments of Gymnasium, POMDP solvers on the PATH, pomdp-py.

Nothing here is imported by the rest of the package; each module needs what it adapts to, and says so.
"""
