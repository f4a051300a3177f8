"""Tasks: simulators with named parameters, supports and summaries."""
