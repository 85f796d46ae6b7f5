"""The workbench: the loop from film to law on a local page. It computes nothing; it asks `flow` and shows what came.

    frictrack app STUDY

State lives in the study's files; long work runs in processes of its own (`jobs`, `work`); no request leaves the
machine.
"""
