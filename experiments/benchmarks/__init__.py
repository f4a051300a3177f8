"""Benchmarks: each prints a table and compares with the usual alternative, in the same process."""
