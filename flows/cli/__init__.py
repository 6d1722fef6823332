"""The command line: one file for the commands of each subject, put together in `flows.cli.app`."""
