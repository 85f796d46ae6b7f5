"""How small a missing effect may be and still be named: frictrack, the ideal detector, and other ways."""

from __future__ import annotations

from diagnosis import force, ours, run, sparse, studies

__all__ = ["force", "ours", "run", "sparse", "studies"]
