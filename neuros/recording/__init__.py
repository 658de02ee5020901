"""Recording: packets of a run into a bag, system load, and provenance.

Each node keeps the bytes of its packets in a *spool* of its own; one recorder process moves them
from there into the bag. ``docs/recording.md`` gives the reasons.
"""
