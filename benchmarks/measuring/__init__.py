"""Shared by the benchmarks: the machine, fragments of pages, compiled loops, and the race at equal error."""
