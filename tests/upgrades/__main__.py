"""Keeps a project, a plugin, a run folder and a bag of this version: ``python -m tests.upgrades``.

Every later version has to read them: test_upgrades.py.
"""

from __future__ import annotations

from .keeping import make

if __name__ == "__main__":
    kept = make()
    size = sum(file.stat().st_size for file in kept.rglob("*") if file.is_file())
    print(f"{kept}: {size / 1e3:.0f} kB")
