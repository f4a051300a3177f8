"""The whipping scene's physics compared with beam theory, and its stability and speed."""
