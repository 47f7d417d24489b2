"""The contenders of `peers.py`: sympflow's methods, hand-written loops, and other packages, on one scene."""
