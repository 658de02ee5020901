"""Reading of bags; :func:`neuros.bag.open` is the public function."""
