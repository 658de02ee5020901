"""Recording: packets of a run into a bag, system load, and provenance.

Each node keeps what it sends, as bytes, in a *spool* of its own; one recorder process moves it from
there into the bag. ``docs/recording.md`` says why.
"""
