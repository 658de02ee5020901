"""``neuros doctor``: checks of this machine, each problem with its remedy in one line."""
