"""frictrack: from a film of a sliding mass to a friction law, and to the physical effect that it lacks."""

__version__ = "0.1.0"
