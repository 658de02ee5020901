"""Fuzzing: whatever a file or another program says, the answer is a sentence.

``targets`` says what is fed with what, ``mutation`` how inputs are changed, ``running`` what is
allowed. ``test_fuzz`` tries some hundreds, and with ``--hypothesis-profile=long`` many thousands.
"""
