"""Which experiment next: designs of a task, rated by what they are expected to say of its parameters."""
