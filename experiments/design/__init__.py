"""Does the experiment that `jaxlfi.design` chooses tell most? See `__main__`."""
