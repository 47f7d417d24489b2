"""What `peers.py` compares: sympflow's methods, hand-written loops, and other packages, on one scene."""
