"""The command line: it reads options, picks the adapters, and knows the exit codes."""
