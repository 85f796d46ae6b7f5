"""Measure how often an unknown cause is named by its formula, on studies that an independent integrator made."""
