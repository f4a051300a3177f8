"""Does it pay to know the object? A puck that is pushed, let go, and has to stop at a mark."""
