"""Does it pay to know the object? Policies of the whip, judged by the scene that they leave behind."""
