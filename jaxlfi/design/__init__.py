"""Which experiment next: designs of a task, rated by the expected information about its parameters."""
