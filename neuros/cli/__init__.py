"""The command line: it reads options, picks the adapters, and knows the exit codes."""

EXIT_CODES = """\
exit codes:
  0    ended normally
  1    a node failed or had to be killed, a deadlock, or a lossless connection lost a packet
  2    wrong usage
  3    invalid project: every problem is listed with its file and line
  4    something is missing on this machine, or a record could not be written
  5    the run broke a budget of its project
  6    verify: the same packets were sent, but hooks took others of them
  7    the Python program that held the run raised an exception
  130  ended by Ctrl+C (a second one kills at once)
  143  ended by SIGTERM, or because the terminal was closed
"""
