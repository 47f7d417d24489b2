"""Runs over traced numbers behind one protocol, of splitting schemes, parts, implicit methods and flows.

A *stage* is a Python function of the values of a state and of the numbers of one column of a table. `runs` writes the
loops around it, which are the same for every method, and `rollouts` makes functions of arrays of them. Loops of a
system are made by `splitting_loops`, `parts_loops` and `newton`; those of one method or flow on it are a
`sympflow.kernels.protocol.Kernel`.
"""
