"""What every flow stands on: the terminal, stop requests, Prefect, and campaigns as steps see them.

Also how work is spread over cores or a cluster.
"""
