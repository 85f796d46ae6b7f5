"""Simulated campaigns: the runs that frictrack names against a fixed design of six runs."""
