"""``neuros doctor``: whether this machine has what runs need, each remedy in the same line."""
