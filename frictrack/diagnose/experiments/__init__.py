"""Plan experiments: the run or the direct check that separates what the present runs cannot; runs before filming."""
