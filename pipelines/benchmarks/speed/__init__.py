"""CPU time of frictrack beside references that are computed in the same run."""
