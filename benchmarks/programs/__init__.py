"""What NeuROS is compared with: programs of their own, without NeuROS."""

MARK = "> "
"""How lines begin that a program prints which Fast DDS prints to as well."""
