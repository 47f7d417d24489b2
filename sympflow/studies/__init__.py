"""What is asked of several runs: comparisons, work–precision, stability, sections, with their tables and figures."""
