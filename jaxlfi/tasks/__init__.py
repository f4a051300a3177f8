"""Tasks: simulators with named, bounded parameters, their priors, summaries and observations."""
