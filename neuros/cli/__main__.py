"""``python -m neuros.cli``: the same as the console script ``neuros``."""

from neuros.cli.main import console_script

if __name__ == "__main__":
    console_script()
