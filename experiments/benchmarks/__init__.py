"""Benchmarks: each prints a table and compares with what a user would run instead, in the same process."""
