"""sympflow where people already work: `interop.scipy`, `interop.torchdiffeq`, `interop.torchode`, `interop.systems`.

Import the module that you need; none is loaded before.
"""
