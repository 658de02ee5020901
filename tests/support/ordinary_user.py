"""What the rights of files mean to an ordinary user, also where the tests run as root."""

from __future__ import annotations

import os

# Root may enter and read everything by two capabilities. Without them it is the user that owns what
# it has made, and has no right to what it has taken all rights from.
AS_ORDINARY_USER = (
    ("setpriv", "--bounding-set=-dac_override,-dac_read_search") if os.geteuid() == 0 else ()
)
"""Comes before a command."""
