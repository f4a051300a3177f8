"""Is the experiment that `jaxlfi.design` chooses the most informative? See `__main__`."""
