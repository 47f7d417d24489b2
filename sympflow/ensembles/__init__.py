"""Many runs at once: `sympflow.ensemble`, its chunks, what is kept of each orbit, and where it is stored."""
