"""The displacement's own problem: pieces of runs, simulated and linearised, refined until the law stops moving."""
