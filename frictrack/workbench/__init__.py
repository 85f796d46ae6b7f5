"""The local web page of a study, from film to friction law. It computes nothing: `flow` does, and the page shows it.

    frictrack app STUDY

State lives in the study's files; long work runs in processes of its own (`jobs`, `work`); no request leaves the
machine.
"""
