"""Measurements behind the claims: each protocol is one command, ``utopic bench PROTOCOL``.

The room's rules: every random draw comes from the seed printed with the result, every
method gets the same data, start poses and final refinement in the same run, and a method
that raises has failed on that pair, which is counted and not hidden.
"""
