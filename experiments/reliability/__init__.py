"""What survives a kill, a full disk, and other adversities: `python -m experiments.reliability`."""
