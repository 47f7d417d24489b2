"""Studies of several runs: comparisons, work and precision, stability, sections, each with its report."""
