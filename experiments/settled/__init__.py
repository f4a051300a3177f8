"""Does it pay to know the object? Policies of the whip that are judged by what they leave behind."""
