"""Compiled loops (Numba): splitting schemes and SympFlows, one trajectory or many. Imported only when needed.

A kernel is one source file made of three parts: the *algebra* of a system (its kicks and drifts on whatever holds
a state), generated or hand-written, and the loops, which are the same for every system. The file lies in a
per-user folder, so that Numba finds its compiled code again in the next process.
"""
