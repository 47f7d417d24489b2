"""Compiled loops (Numba) behind one protocol: splitting schemes, parts, implicit methods, flows. Imported when needed.

A source file is made of three parts: the *algebra* of a system (its kicks and drifts on whatever holds a
state), generated or hand-written; functions that depend on the kinds of kick; and the loops of `sympflow.kernels.text`,
which are the same for every system. The file lies in a per-user folder, so that Numba finds its compiled code again in
the next process. Loops of a system are made by `splitting_loops`, `parts_loops` and `implicit_kernel`; those of one
method or flow on it are a `sympflow.kernels.protocol.Kernel`.
"""
