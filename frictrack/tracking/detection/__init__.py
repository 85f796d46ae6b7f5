"""Locate what to track: the moving body, a click, a rectangle, an outline, a picture; and a fixed reference."""
