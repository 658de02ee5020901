"""Recording: the way of a run's packets into a bag.

Each node keeps what it sends, as bytes, in a *spool* of its own; one recorder process moves it from
there into the bag. ``docs/recording.md`` says why. Load and versions are recorded here, too.
"""
