"""The command line: one module a command, behind one error boundary."""
