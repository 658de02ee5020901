"""Recording and analysis of runs.

Recording: :mod:`~neuros.observe.recording`, :mod:`~neuros.observe.bag`,
:mod:`~neuros.observe.load`, :mod:`~neuros.observe.load_table`, :mod:`~neuros.observe.provenance`;
all else is analysis, which reads what these have written.
"""
