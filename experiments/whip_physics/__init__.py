"""The whipping scene's physics against beam theory, and how stable and fast it is."""
