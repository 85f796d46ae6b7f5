"""Stored outputs of frictrack, to compare with those of changed code."""
