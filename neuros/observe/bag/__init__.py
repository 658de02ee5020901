"""Reading what a run has recorded: :func:`neuros.bag.open` is its public face."""
