"""Cases and comparisons."""
