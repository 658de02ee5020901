"""``neuros reproduce``: the published experiments again, and the figures and tables of them."""
