"""The outputs of frictrack, stored, to be compared with those of changed code."""
