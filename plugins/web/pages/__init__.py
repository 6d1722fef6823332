"""The web application of a store: what runs, controls, trials, labels, report, log, schedules."""
