"""How quickly the workbench answers, beside the charts of Bokeh."""
