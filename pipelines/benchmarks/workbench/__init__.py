"""Benchmark of the workbench: response times, compared with charts of Bokeh alone."""
