"""Clients of the public interface that test it: the published examples (`reproduce`) and sealed studies (`blind`)."""
