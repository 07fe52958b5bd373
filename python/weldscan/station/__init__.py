"""The measuring cell at work: its configuration, the scan, and the commands for both."""
