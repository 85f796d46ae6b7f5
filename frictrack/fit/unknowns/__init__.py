"""What is unknown in a model over some runs: its slots, the rules that tie them, levels that scatter, a mass."""
