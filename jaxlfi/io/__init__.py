"""Files, serialisation, progress and the compile cache."""
