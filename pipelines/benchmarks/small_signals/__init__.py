"""Benchmark of small hidden effects: how often frictrack and an ideal detector find and name them."""
