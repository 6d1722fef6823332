"""Deployments of one rig on Prefect's page: schedules, windows, how served runs begin and end."""
