"""Serve a study as a local web page. The page computes nothing; it calls `flow` and shows its results.

    frictrack app STUDY

The state is in the study's files. Long jobs run in their own processes (`jobs`, `job_process`). No request leaves
the machine.
"""
