"""Installation of NeuROS on a bare Python, and facts about this machine.

It runs before anything is installed: standard library only, and nothing of NeuROS but its errors.
Everything that can be missing on a machine ends in one sentence with the command that mends it.
"""
