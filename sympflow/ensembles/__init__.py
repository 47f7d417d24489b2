"""Many runs at once: `sympflow.ensemble`, its chunks, the results of each orbit, and their stores."""
