"""Experiments: the tables and figures of the paper, ablations and benchmarks."""
