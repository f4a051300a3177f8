"""bayessim."""
