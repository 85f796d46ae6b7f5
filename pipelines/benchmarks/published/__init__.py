"""Score frictrack on published benchmarks in the way in which each of them is scored."""
